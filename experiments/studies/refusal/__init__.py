"""Maps of different worlds crossed: are those refused, and only those?"""
