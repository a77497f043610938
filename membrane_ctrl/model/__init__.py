"""Values, errors, files and bytes that every room above knows: no control, no device."""
