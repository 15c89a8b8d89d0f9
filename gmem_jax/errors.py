"""Every exception of the package that a caller may want to catch."""


class RunFailedError(RuntimeError):
    """A run whose numbers are meaningless: a grain escaped, a number overflowed, an overlap left the law's range."""


class NotAtRestError(RunFailedError):
    """A pack that did not come to rest in the time allowed; with more patience its preparation goes on."""


class FileFormatError(ValueError):
    """A file that is damaged, or is not what it should be."""
