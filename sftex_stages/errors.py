"""What can go wrong in a way that a user can mend.

Every message names the file (and key and line where there is one) and says what to do. Anything that is not a
`SftexError` is a defect of sftex itself and is shown with its traceback.
"""


class SftexError(Exception):
    """Base of all errors that are the input's, not the program's."""


class ConfigError(SftexError):
    """The configuration or the command line is wrong."""


class InputError(SftexError):
    """An image, a mask, a result or a truth file cannot be used."""


class StoreError(SftexError):
    """The artefact store or an output folder cannot be read or written."""


class StageError(SftexError):
    """A stage cannot do its work on this image (no keypoints, no usable texton, ...)."""
