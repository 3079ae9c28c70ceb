"""How fast the engines, the environments and the planners are on this machine."""
