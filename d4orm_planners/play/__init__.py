"""A playground: a team that a policy drives, live in a browser, to look at and to meddle with."""
