"""Excitation signals for measurements: their design and their files."""
