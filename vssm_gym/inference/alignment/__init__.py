"""Align images: residuals of a pose, robust Gauss-Newton, Adam, and the reference view that poses are aligned to."""
