"""Localise a camera in a known map: tracking, keyframes, recovery, and tracking through the renderer."""
