"""Talking-head data sets."""
