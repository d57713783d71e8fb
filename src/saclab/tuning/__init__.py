"""A search for settings: the space, what a trial is worth, the study on disk, the loop, the page."""
