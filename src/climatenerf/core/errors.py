"""The one exception that speaks to a user."""


class UserError(Exception):
    """Input or a request that the user can correct.

    The message is one sentence: what is wrong, where, and what to do about it. The command line
    prints it and exits with status 2; it never shows a traceback for it.
    """
