"""One view per kind of hint: it knows how to draw a kind, and no stage."""
