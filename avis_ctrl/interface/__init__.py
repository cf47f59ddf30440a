"""The Python interface of the commands, offered by `import avis_ctrl as ac`."""
