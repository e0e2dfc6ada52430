"""Hold the processes that train a run together, and what they do in common.

Two groups of `torch.distributed` do the work: one of gloo for decisions and small objects, on the processor, and one of
the device for sums of tensors, NCCL on GPUs. Every rank calls the same methods in the same order.
"""

from __future__ import annotations

import os
import re
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from typing import Any, TypeVar

import torch
from torch import Tensor

from lapgs_plugin import interrupt
from lapgs_plugin.errors import LapgsError, MissingExtraError, UserInputError, first_line
from lapgs_plugin.stages.view_transforms import Processes
from lapgs_plugin.training.ranks.shards import tree_sum

PATIENCE = timedelta(days=1)
"""How long a rank waits for the others: a viewer may hold training. Ranks that die are noticed at once."""
JOINING = timedelta(minutes=5)
"""How long a rank waits for the port of the group to answer."""
STEPS_A_DECISION = 8
"""Steps from one decision in common to the next on GPUs: each costs about 0.1 ms, and a step a few."""
ROWS_OF_A_MESSAGE = 1 << 20
"""Rows of a tensor that are sent to rank 0 at once: gloo's messages have a limit."""

_FAILURE = "lapgs/failure"
"""Key of the group's store under which the first rank that fails by itself says why."""

_Value = TypeVar("_Value")


class RankLostError(LapgsError):
    """Another rank has ended, so that this one cannot go on."""


class Ranks(Processes):
    """Train in this process alone; `JoinedRanks` has several.

    Attributes:
        rank: of this process; 0 leads: it alone writes, shows and is measured.
        size: number of ranks.
        steps_a_decision: steps from one call of `decide` to the next.
    """

    rank: int = 0
    size: int = 1
    steps_a_decision: int = 1

    @property
    def leads(self) -> bool:
        """Whether this rank writes the run folder and talks to the user."""
        return self.rank == 0

    @property
    def together(self) -> str:
        """The option that asked for this group, for messages."""
        return "--gpus 1"

    def use(self, device: torch.device) -> None:
        """Prepare sums of tensors on the device that trains."""

    def wait(self) -> None:
        """Wait until every rank has come here."""

    def from_leader(self, value: _Value) -> _Value:
        """Return the value that rank 0 passed."""
        return value

    def gathered(self, value: _Value) -> list[_Value]:
        """Return the values of all ranks, in their order."""
        return [value]

    def decide(self, *wishes: bool) -> tuple[bool, ...]:
        """Return for each wish whether any rank has it."""
        return wishes

    def sum(self, tensors: Sequence[Tensor]) -> list[Tensor]:
        """Return the sums of tensors over all ranks, to the same bits on each. Arguments are used up."""
        return list(tensors)

    def sum_of(self, tensor: Tensor | None, like: Tensor) -> Tensor | None:
        """Return the sum of a tensor over all ranks, which is kept; None, on some ranks, counts as zeros."""
        return tensor

    def largest(self, tensor: Tensor) -> Tensor:
        """Return the elementwise maximum over all ranks."""
        return tensor

    def as_leader(self, tensor: Tensor) -> Tensor:
        """Return the tensor of rank 0, for results that a GPU may round otherwise each time; all have its shape."""
        return tensor

    def exchange(self, rows: Tensor, counts: Sequence[int], received: Sequence[int]) -> Tensor:
        """Send rows of a tensor (n, c) to all ranks: the first `counts[0]` to rank 0, and so on.

        Args:
            rows: without gradients.
            counts, received: numbers of rows that this rank sends to each, and that each sends to this one.

        Returns:
            Rows that arrived, those of rank 0 first.
        """
        return rows

    def rows_of_all(self, tensor: Tensor) -> Tensor:
        """Return the rows of all ranks' tensors, one after the other, on rank 0's processor; others keep theirs."""
        return tensor

    @contextmanager
    def explained(self) -> Iterator[None]:
        """Let rank 0, inside the block, raise the error of the rank that failed instead of that rank's loss.

        Ranks but 0 print nothing, and the ranks of several machines have no folder in common before a run has one.

        Raises:
            RankLostError: on rank 0, with the message of the rank that failed first.
        """
        yield

    def close(self) -> None:
        """Leave the group."""


ALONE = Ranks()
"""The group of one."""


class AskedRanks(Ranks):
    """Describe ranks that are not started yet, to tell whether they can be.

    Args:
        option: that asks for them.
        size: their number.
    """

    def __init__(self, option: str, size: int) -> None:
        self.size, self._option = size, option

    @property
    def together(self) -> str:
        return f"{self._option} {self.size}"


class JoinedRanks(Ranks):
    """Train with other processes, which torchrun's agent started with this one.

    Args:
        rank, size, local_rank: see `Ranks`; the last is the rank among those of this machine.
    """

    def __init__(self, rank: int, size: int, local_rank: int) -> None:
        import torch.distributed as dist
        from torch.distributed.rendezvous import rendezvous

        self.rank, self.size, self._local_rank = rank, size, local_rank
        self._dist: Any = dist
        self._device = torch.device("cpu")
        self._sums: Any = None  # NCCL's group; None is that of gloo
        if local_rank < torch.cuda.device_count():
            torch.cuda.set_device(local_rank)  # before anything is put on a GPU
        try:
            self._store: Any = next(rendezvous("env://", rank, size, timeout=JOINING))[0]
            dist.init_process_group("gloo", store=self._store, rank=rank, world_size=size, timeout=PATIENCE)
        except (RuntimeError, ValueError) as error:
            raise UserInputError(
                f"rank {rank} of {size} cannot reach the others ({_reason(error)}); is the port of MASTER_PORT, "
                f"{os.environ.get('MASTER_PORT', '')}, taken? torchrun --standalone or --gpus take a free one"
            ) from error

    @property
    def together(self) -> str:
        return f"--gpus {self.size}" if self._device.type == "cuda" else f"{self.size} ranks"

    def use(self, device: torch.device) -> None:
        self._device = device
        if device.type != "cuda":
            return
        here = torch.cuda.device_count()
        if self._local_rank >= here:
            raise UserInputError(
                f"rank {self.rank} of {self.size} has no GPU: this machine has {here}; start as many ranks as GPUs"
            )
        if not self._dist.is_nccl_available():
            raise MissingExtraError(
                f"--gpus {self.size}: this PyTorch, {torch.__version__}, is built without NCCL; install one for CUDA "
                "on Linux, or train on one GPU"
            )
        self.steps_a_decision = STEPS_A_DECISION
        if self._sums is None:
            with self._others():
                self._sums = self._dist.new_group(backend="nccl", timeout=PATIENCE)
                self._dist.all_reduce(torch.zeros(1, device=device), group=self._sums)  # connects the GPUs

    def wait(self) -> None:
        with self._others():
            self._dist.barrier()

    def from_leader(self, value: _Value) -> _Value:
        values = [value]
        with self._others():
            self._dist.broadcast_object_list(values, src=0)
        return values[0]

    def gathered(self, value: _Value) -> list[_Value]:
        values: list[Any] = [None] * self.size
        with self._others():
            self._dist.all_gather_object(values, value)
        return values

    def decide(self, *wishes: bool) -> tuple[bool, ...]:
        flags = torch.tensor(wishes, dtype=torch.int32)
        with self._others():
            self._dist.all_reduce(flags, self._dist.ReduceOp.MAX)
        return tuple(map(bool, flags.tolist()))

    def sum(self, tensors: Sequence[Tensor]) -> list[Tensor]:
        if self._device.type != "cuda":
            return self._sum_in_order(tensors)
        with self._others():
            whole = [tensor.contiguous() for tensor in tensors]
            # All are under way before the first is waited for, and their kernels follow each other without gaps.
            works = [self._dist.all_reduce(tensor, group=self._sums, async_op=True) for tensor in whole]
            for work in works:
                work.wait()  # for the GPU's queue, not for the processor
        return whole

    def _sum_in_order(self, tensors: Sequence[Tensor]) -> list[Tensor]:
        """Return sums whose bits do not depend on how the views are shared out; see `shards.tree_sum`."""
        flat = torch.cat([tensor.reshape(-1) for tensor in tensors]) if tensors else torch.zeros(0)
        gathered = [torch.empty_like(flat) for _ in range(self.size)]
        with self._others():
            self._dist.all_gather(gathered, flat)
        total = tree_sum([[part] for part in gathered])
        assert total is not None, "every rank has one"
        parts = torch.split(total[0], [tensor.numel() for tensor in tensors])
        return [part.view(tensor.shape) for part, tensor in zip(parts, tensors, strict=True)]

    def sum_of(self, tensor: Tensor | None, like: Tensor) -> Tensor | None:
        own = torch.zeros_like(like, requires_grad=False) if tensor is None else tensor.clone()
        return self.sum([own])[0]

    def largest(self, tensor: Tensor) -> Tensor:
        with self._others():
            self._dist.all_reduce(tensor, self._dist.ReduceOp.MAX, group=self._sums)
        return tensor

    def as_leader(self, tensor: Tensor) -> Tensor:
        with self._others():
            self._dist.broadcast(tensor, src=0, group=self._sums)
        return tensor

    def exchange(self, rows: Tensor, counts: Sequence[int], received: Sequence[int]) -> Tensor:
        arrived = rows.new_empty(sum(received), *rows.shape[1:])
        with self._others():
            self._dist.all_to_all_single(arrived, rows.contiguous(), [*received], [*counts], group=self._sums)
        return arrived

    def rows_of_all(self, tensor: Tensor) -> Tensor:
        counts, own = self.gathered(len(tensor)), tensor.detach().cpu().contiguous()
        whole = own.new_empty(sum(counts), *own.shape[1:]) if self.leads else own
        with self._others():
            if not self.leads:
                for part in torch.split(own, ROWS_OF_A_MESSAGE) if len(own) else ():
                    self._dist.send(part, 0)
                return own
            start = counts[0]
            whole[:start] = own
            for rank, count in enumerate(counts[1:], start=1):
                for part in torch.split(whole[start : start + count], ROWS_OF_A_MESSAGE) if count else ():
                    self._dist.recv(part, rank)
                start += count
        return whole

    @contextmanager
    def explained(self) -> Iterator[None]:
        try:
            yield
        except (RankLostError, interrupt.Interrupted):  # the agent ends the other ranks of one that failed
            interrupt.ignore()
            if self.leads and (failure := self._failure()) is not None:
                interrupt.withdraw()
                raise RankLostError(*failure.splitlines()) from None
            raise
        except Exception as error:
            text = str(error) if isinstance(error, LapgsError) else traceback.format_exc()
            with suppress(RuntimeError):  # nobody is left
                if self._failure() is None:
                    self._store.set(_FAILURE, f"rank {self.rank} of {self.size}: {text}")
            raise

    def _failure(self) -> str | None:
        """Return why a rank failed, if one did by itself and could say so."""
        with suppress(RuntimeError):  # its store may be gone with it
            if self._store.check([_FAILURE]):
                return str(self._store.get(_FAILURE).decode())
        return None

    def close(self) -> None:
        if self._sums is not None:
            torch.cuda.synchronize()
        self._dist.destroy_process_group()
        self._store = None  # rank 0's holds the port of the next group

    @contextmanager
    def _others(self) -> Iterator[None]:
        """Turn an error about another rank into one line."""
        try:
            yield
        except torch.cuda.OutOfMemoryError:
            raise
        except (RuntimeError, ValueError) as error:
            raise RankLostError(
                f"rank {self.rank} of {self.size} lost another rank ({_reason(error)}); the last checkpoint "
                "continues with --resume, also on fewer ranks"
            ) from error


def _reason(error: BaseException) -> str:
    """Return the first sentence of an error of a communication library, without the source file that begins it.

    >>> _reason(RuntimeError("[/builds/gloo/pair.cc:553] Connection closed by peer [127.0.0.1]:1680. See the logs."))
    'Connection closed by peer [127.0.0.1]:1680'
    """
    return re.sub(r"^\[\S*\] ", "", first_line(error)).split(". ")[0]


def joined() -> Ranks:
    """Return the group that torchrun's agent started this process in, or that of one."""
    size = int(os.environ.get("WORLD_SIZE", "1")) if "TORCHELASTIC_RUN_ID" in os.environ else 1
    if size == 1:
        return ALONE
    alone = os.environ.get("LOCAL_WORLD_SIZE") == str(size)
    if alone and sys.platform == "linux":  # its name may not resolve
        os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    return JoinedRanks(int(os.environ["RANK"]), size, int(os.environ["LOCAL_RANK"]))
