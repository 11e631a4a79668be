"""The catalogue of many run folders: an index in SQL that can be deleted and made again, and what it answers."""
