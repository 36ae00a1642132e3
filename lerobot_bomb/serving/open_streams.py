"""Limits on requests, so that clients that send nothing cannot hold a server's workers."""

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import grpc

# requests that are still being received; one more cancels the oldest of them: a robot sends the newest
MAX_OPEN = 8
RECEIVE_TIMEOUT_S = 10.0  # an observation that takes longer is of no use to a robot
WORKERS = 2 * MAX_OPEN


class OpenStreams(grpc.ServerInterceptor):
    """Limits on requests: the time to receive one, and the number received at once."""

    def __init__(self, max_open: int = MAX_OPEN, timeout_s: float = RECEIVE_TIMEOUT_S):
        self.max_open, self.timeout_s = max_open, timeout_s
        self._open: deque[grpc.ServicerContext] = deque()
        self._lock = threading.Lock()

    def intercept_service(self, continuation: Callable, handler_call_details: Any) -> Any:
        """Replace the method by one that is called at once; gRPC would let a worker wait for the message."""
        handler = continuation(handler_call_details)
        if handler is None:
            return None

        def streamed(requests: Iterator, context: grpc.ServicerContext) -> Any:
            with self._receiving(context):
                return handler.stream_unary(requests, context)

        def single(requests: Iterator, context: grpc.ServicerContext) -> Any:
            with self._receiving(context):
                request = next(requests)
            return handler.unary_unary(request, context)

        return grpc.stream_unary_rpc_method_handler(
            streamed if handler.request_streaming else single,
            request_deserializer=handler.request_deserializer,
            response_serializer=handler.response_serializer,
        )

    @contextmanager
    def _receiving(self, context: grpc.ServicerContext) -> Iterator[None]:
        timer = threading.Timer(self.timeout_s, context.cancel)
        timer.daemon = True
        timer.start()
        with self._lock:
            self._open.append(context)
            oldest = self._open.popleft() if len(self._open) > self.max_open else None
        if oldest is not None:
            oldest.cancel()
        try:
            yield
        finally:
            timer.cancel()
            with self._lock, suppress(ValueError):  # the oldest is not among them
                self._open.remove(context)
