"""Infer beliefs over pose and map from RGB-D images and controls."""
