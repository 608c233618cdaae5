"""Contents of result.json as text and as HTML; knows dictionaries only."""
