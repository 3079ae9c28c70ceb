"""Learning with libraries of others, a program each."""
