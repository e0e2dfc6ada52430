"""State that a browser viewer would share with training: which training view it wants, and the last image of it."""

curr_id = -1
latest_width = 0
latest_height = 0
latest_result = b""


def init(wish_host, wish_port):
    raise ConnectionError(f"no viewer in this checkout to serve on {wish_host}:{wish_port}")
