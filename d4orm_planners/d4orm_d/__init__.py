"""D4orm-D: failure-aware decoupling for big teams (paper, section V)."""
