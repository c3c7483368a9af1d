"""What can go wrong with a leaderboard before or between its cells; each message says what to do."""


class LeaderboardError(Exception):
    """The leaderboard cannot start or go on; the message is for the person at the command line."""


class ResultsFolderError(LeaderboardError):
    """The results folder cannot be written, or another run is using it."""


class ChangedConfigurationError(LeaderboardError):
    """Finished records belong to an older configuration of their cells."""


class CorruptRecordError(LeaderboardError):
    """A record file is not what a record should be."""


class NotPlainJSONError(ValueError):
    """A value is not plain, finite JSON."""
