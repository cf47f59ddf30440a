"""Blind campaigns: effects hidden by an independent truth, named by the gap finder, scored afterwards.

    python -m benchmarks.blind --cases 300 --seed 1 --jobs 2 --duration 60 --out blind.jsonl [--resume] [--unseen]
    python -m benchmarks.blind.score blind.jsonl [--markdown blind.md] [--png blind.png]

Both from the root of the repository. The first takes hours and may be killed and resumed; the second also
draws the confusion matrix, beside the lines. `seed_93000.jsonl.gz` has the lines for the table in docs/gap_engine.md.
"""
