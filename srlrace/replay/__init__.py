"""Replays: flights as one self-contained HTML page."""
