"""The command line, the Ray session, the campaign (the alternation), reports."""
