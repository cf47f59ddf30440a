"""The identification report: its content, one file a section."""
