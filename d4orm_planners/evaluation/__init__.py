"""How fast the engines, environments and planners are, and the plain formulation they are held against."""
