"""A controller as a process that speaks ROS 2's wire over Zenoh; extras ``ros`` and ``zenoh``."""
