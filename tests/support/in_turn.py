"""Times of two functions that are called in turn, so that both meet the same load of the machine."""

from time import process_time


def in_turn(ours, peer, rounds):
    """Seconds of CPU time of both in each round, and the results of the last round."""
    rows = []
    for _ in range(rounds):
        seconds, results = [], []
        for function in (ours, peer):
            begin = process_time()
            results.append(function())
            seconds.append(process_time() - begin)
        rows.append(seconds)
    return rows, results
