"""What is shown unless told otherwise; read by the command line, too, so that nothing heavy is imported here."""

#: Seconds of a log that are shown.
SECONDS = 10.0
#: Seconds of an open-loop prediction.
HORIZON = 1.0
