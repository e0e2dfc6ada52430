"""State that a viewer would share with training; no viewer ever connects to a stub."""

host = "127.0.0.1"
port = 6009
conn = None


def init(wish_host, wish_port):
    global host, port
    host, port = wish_host, wish_port


def try_connect():
    """Set `conn` if a viewer is waiting."""


def receive():
    raise ConnectionError("no viewer")


def send(message_bytes, verify):
    raise ConnectionError("no viewer")
