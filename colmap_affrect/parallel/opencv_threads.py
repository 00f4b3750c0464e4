"""OpenCV's own threads, shared among those of this process."""

from threading import Lock

import cv2


class _SharedThreads:
    """OpenCV's threads, shared equally among the threads that are inside at the time.

    With all of them for each of two images at once, extraction takes longer.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._num_inside, self._num_threads = 0, 1

    def __enter__(self) -> None:
        with self._lock:
            if not self._num_inside:
                self._num_threads = cv2.getNumThreads()
            self._share(self._num_inside + 1)

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._share(self._num_inside - 1)

    def _share(self, num_inside: int) -> None:
        self._num_inside = num_inside
        cv2.setNumThreads(max(1, self._num_threads // max(1, num_inside)))


SHARED_OPENCV_THREADS = _SharedThreads()  # to be held while an image is worked on
