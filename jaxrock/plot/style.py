"""Colours that all figures share."""

BLUE, RED, GREY, SAND = "#1f5a8a", "#b3352c", "#8a8a8a", "#d9a441"
