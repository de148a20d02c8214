"""Process replay: what graspd says of known input stays what it was, or a test says where not.

References stand in `tests/references`: the verdicts on known streams (`verdicts`), the messages of
some of these runs (`messages`), and what the commands say (`commands`). To compare with them, or
renew them and then see what changed by `git diff`:

    python -m tests.process_replay
    python -m tests.process_replay --renew
"""
