"""Colours that server and station have in common."""

LABEL_COLOURS = (
    "#4f83e0",
    "#33b08a",
    "#e0ac3b",
    "#e0654f",
    "#a279dc",
    "#3fb7cf",
    "#d985b4",
    "#93a55a",
)
"""Of labels 1, 2, 3 ... (and again from the front): apart from each other for colour-blind eyes as well, calm on black."""

BACKGROUND_RGB = (22, 25, 30)
"""What missing pixels look like where nothing can be transparent."""
