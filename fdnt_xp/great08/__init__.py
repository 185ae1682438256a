"""The GREAT08 challenge: read its directories, simulate them, measure them, score the answers."""
