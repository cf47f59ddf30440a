"""The report of `avis gap`: its content, one file a section."""
