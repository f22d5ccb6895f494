"""Predict a recorded motion 100 steps ahead by a learned transition and by plain integration, and score both."""
