"""Path finding for the whole team on a graph in the free space, and driving along what it found."""
