"""Every exception of the package that a caller may want to catch."""


class RunFailedError(RuntimeError):
    """A run whose numbers are meaningless: a grain escaped, a number overflowed, an overlap left the law's range."""


class FileFormatError(ValueError):
    """A file that is damaged, or is not what it should be."""
