"""Parametric heads behind one interface."""
