"""Several processes of one thread each that share every batch: less waiting than one process of several threads."""

import argparse
import os
import subprocess
import sys

import torch


def add_arguments(p):
    p.add_argument("--ranks", type=int, default=1, help="processes that share a batch and average gradients")
    p.add_argument("--rank", type=int, default=0, help=argparse.SUPPRESS)
    p.add_argument("--threads", type=int, default=1, help="threads of each process")
    p.add_argument("--port", type=int, default=29511, help="local port the processes meet at")


def run(module, args, argv, work):
    """Calls `work(reduce)` in every rank; rank 0 starts the others with the same command line.

    `reduce` sums a tensor over the ranks in place; None with one rank.
    """
    torch.set_num_threads(args.threads)
    torch.set_flush_denormal(True)
    if args.ranks == 1:
        return work(None)
    others = []
    if args.rank == 0:
        given = list(sys.argv[1:] if argv is None else argv)
        for rank in range(1, args.ranks):
            others.append(subprocess.Popen([sys.executable, "-m", module, *given, "--rank", str(rank)]))
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(args.port)}
    try:
        torch.distributed.init_process_group("gloo", rank=args.rank, world_size=args.ranks)
        work(torch.distributed.all_reduce)
    except BaseException:
        for process in others:
            process.terminate()
        raise
    for process in others:
        process.wait()
