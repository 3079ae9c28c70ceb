"""Reinforcement learning with Stable-Baselines3, and the policies it makes."""
