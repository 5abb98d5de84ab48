"""Learning: PPO on the race, policy files, checkpoints that resume exactly."""
