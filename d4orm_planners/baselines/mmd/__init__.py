"""MMD: every robot's motion denoised by a diffusion model of single robots, conflicts resolved by a search."""
