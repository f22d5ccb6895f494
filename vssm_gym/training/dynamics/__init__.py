"""Learn transitions from logs of poses and controls: windows, baselines, training, evaluation."""
