"""A plug-in for nerfgrasp, to copy: one pose parameterization."""
