"""The `pbfd` command. It stands on top: it may import everything, and nothing imports it."""
