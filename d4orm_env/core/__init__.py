"""The physics, written once: dynamics, docking, collision, reward, observation and metrics."""
