"""A server of a model that is none: the guard and the server of ``plan serve``, before an application that answers at
once, or after as many milliseconds as tokens are wanted. Run as a program it says where it listens."""

import asyncio
import json
import socket
import sys


async def app(scope, receive, send):
    """As llama-cpp-python's application does: a question takes a thread, one at a time."""
    if scope["type"] == "lifespan":
        while (await receive())["type"] == "lifespan.startup":
            await send({"type": "lifespan.startup.complete"})
        return await send({"type": "lifespan.shutdown.complete"})
    found = {"object": "list", "data": [{"id": "mine"}]}
    if scope["method"] == "POST":
        request = json.loads((await receive())["body"])
        assert not app.busy
        app.busy = True
        await asyncio.sleep(request.get("max_tokens", 0) / 1000)
        app.busy, app.asked = False, app.asked + 1
        message = {"role": "assistant", "content": json.dumps([app.asked, request])}
        found = {
            "object": "chat.completion",
            "model": "mine",
            "choices": [{"message": message, "finish_reason": "stop"}],
        }
    headers = [(b"content-type", b"application/json")]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    await send({"type": "http.response.body", "body": json.dumps(found).encode()})


app.busy, app.asked = False, 0

if __name__ == "__main__":
    from lw_torchrl.planners import guard
    from lw_torchrl.planners.model_server import local_names

    guard.HEAD_SECONDS, guard.BODY_SECONDS, guard.WAITING = 1.0, 1.0, 4
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        print(listener.getsockname()[1], flush=True)
        guard.run_server(guard.Guard(app, "mine", 8192, local_names("127.0.0.1")), listener)
    sys.exit(0)
