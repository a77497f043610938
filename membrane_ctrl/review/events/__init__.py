"""Events found in a run that nobody reported."""
