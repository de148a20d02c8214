"""Process replay: what graspd says of known input stays what it was, or a test says where not.

References stand in `tests/references`: the verdicts on known streams (`verdicts`), the bytes of the
messages of some of these runs (`messages`), and what the commands say (`commands`). Compare, and
renew them, and look at what `git diff` says, with

    python -m tests.process_replay
    python -m tests.process_replay --renew
"""
