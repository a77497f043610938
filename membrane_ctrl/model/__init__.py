"""Values, errors, files and bytes that every package above uses: no control, no device."""
