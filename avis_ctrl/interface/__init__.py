"""The Python interface: what `import avis_ctrl as ac` offers beyond the parts below it."""
