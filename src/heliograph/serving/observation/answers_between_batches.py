"""Answers that are computed between batches; while one is being taken, those before it."""

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")
PATIENCE = 1.0  # seconds that a batch may take before the answer before it is told


class LastAnswers(Generic[T]):
    """Answers questions about a service, with the answer before a batch while that is being taken, as it may long be.

    Args:
        lock: that which is held while a batch is taken.
        answer: computes the answer to a question, of what does not change while the lock is held.
        begin: the answer to a question that was not asked before.
        most: answers that are kept, those that were asked for last.
    """

    def __init__(self, lock: threading.Lock, answer: Callable[[str], T], begin: T, most: int = 1):
        """Hold how a question is answered; no question was asked yet. The arguments are the class's."""
        self.lock, self.answer, self.begin, self.most = lock, answer, begin, most
        self._last: OrderedDict[str, T] = OrderedDict()

    def ask(self, question: str = "") -> T:
        """Return the answer to a question, computed now, or the last one if a batch holds the lock for too long.

        The longest wait is PATIENCE (1 s), so that a page answers while a long batch is taken. A question that was
        never answered gets `begin`. The answers to the last `most` questions are kept.
        """
        if self.lock.acquire(timeout=PATIENCE):
            try:
                self._last[question] = self.answer(question)
                self._last.move_to_end(question)
                while len(self._last) > self.most:
                    self._last.popitem(last=False)
            finally:
                self.lock.release()
        return self._last.get(question, self.begin)
