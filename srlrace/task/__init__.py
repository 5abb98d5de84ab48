"""The racing task: what the policy sees, what it is rewarded for, how episodes start and end."""
