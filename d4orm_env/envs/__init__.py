"""Environments of PettingZoo and Gymnasium, single and batched."""
