"""How often a 95 % interval holds the truth, on logs whose truth is known. See README.md."""
