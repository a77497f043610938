"""Report pages: content as data, one template, one style."""
