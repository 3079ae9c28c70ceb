"""What D-D4orm is made of: choosing and merging candidates, their messages, the transport, the nodes."""
