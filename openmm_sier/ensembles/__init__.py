"""What happens between the flows that an engine follows: nothing, volume moves, or the decision on a trial.

An ensemble is frozen data with one operation, `advance`. It knows engines only by `engines.protocol.Engine`, so that it
is written once for all of them.
"""
