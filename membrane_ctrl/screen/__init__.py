"""The live screen: what a person sees while the mirror is held."""
