"""The exact search and its two bookkeepings."""
