"""Identification report, one module per section."""
