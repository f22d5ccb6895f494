"""Test studies that have folders of their own."""
