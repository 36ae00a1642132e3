"""LeRobot's policy server, as `lerobot-bomb serve` starts it."""

import os
import pickle
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any


def serve_registered_policies(
    config: Any, address: str, loads: Callable[[bytes], Any], interceptor: Any, workers: int
) -> Any:
    """Start LeRobot's policy server for every registered policy type; return gRPC's server.

    LeRobot's command knows a list of its types, imports no plugins, unpickles whatever it receives, and four
    requests that never end stop it. `config` is a PolicyServerConfig.

    Raises:
        ValueError: the server cannot listen on the address.
    """
    import grpc
    from lerobot.async_inference import policy_server
    from lerobot.configs import PreTrainedConfig
    from lerobot.transport import services_pb2_grpc
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    policy_server.SUPPORTED_POLICIES[:] = sorted(PreTrainedConfig.get_known_choices())
    policy_server.pickle = SimpleNamespace(loads=loads, dumps=pickle.dumps)  # pyright: ignore
    server = grpc.server(
        ThreadPoolExecutor(workers), interceptors=[interceptor], options=[("grpc.so_reuseport", 0)]
    )
    services_pb2_grpc.add_AsyncInferenceServicer_to_server(policy_server.PolicyServer(config), server)
    usual = os.umask(0o177)  # a Unix socket lets in its owner only
    try:
        server.add_insecure_port(address)
    except RuntimeError:
        raise ValueError(f"{address} cannot be listened on") from None
    finally:
        os.umask(usual)
    server.start()
    return server
