"""Generated logs whose truth the diagnosis does not see, and how often it names it. See README.md."""
