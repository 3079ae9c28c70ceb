"""D4orm-C2F: receding-horizon control along a coarse plan (paper, section VI)."""
