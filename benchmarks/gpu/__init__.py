"""How fast is everything on a GPU? See __main__.py."""
