"""MMD, ours after Shaoul et al.: diffusion of single robots' motions, conflicts resolved by a search."""
