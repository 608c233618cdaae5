"""Nine small studies whose every number is kept: what a change of structure must not change."""
