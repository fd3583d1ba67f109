"""A robot and its vision as an operator reaches them, over any link."""
