"""Batched quadrotor physics: compiled kernels over structure-of-arrays state, no learning and no files."""
