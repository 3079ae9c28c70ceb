"""D-D4orm: planning across nodes that exchange their candidates (paper, section VII)."""
