"""Broken files and strange options for every verb: how often this program fails where its input did."""
