"""A server of the tests' own that answers as InfluxDB does, from a list, and keeps what it was asked."""

import json
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from urllib.parse import parse_qs, urlsplit


class Answering(ThreadingHTTPServer):
    """Answers: to a query a list of series, a body, or (status, body); to a write by the statuses given, then 204.

    The form of each answer is the one that InfluxDB documents: for /query and /write of versions 1, 2 and 3, for
    /api/v2/query (Flux), and for /api/v3/query_sql.
    """

    daemon_threads = True

    def __init__(self, answer=(), writes=()):
        super().__init__(("127.0.0.1", 0), _Handler)
        self.answer, self.writes, self.asked = answer, list(writes), []

    @property
    def url(self):
        return f"influx://127.0.0.1:{self.server_port}/plant"

    def __enter__(self):
        Thread(target=self.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        return self

    def __exit__(self, *_):
        self.shutdown()
        self.server_close()


class _Handler(BaseHTTPRequestHandler):
    server: Answering

    def do_GET(self):
        path = urlsplit(self.path)
        self.server.asked.append((path.path, parse_qs(path.query), self.headers.get("Authorization"), b""))
        if path.path == "/ping":
            self.say(204, b"")
        elif isinstance(self.server.answer, bytes):
            self.say(200, self.server.answer)
        elif isinstance(self.server.answer, tuple) and len(self.server.answer) == 2:
            self.say(*self.server.answer)
        else:
            results = [{"statement_id": 0, "series": list(self.server.answer)}]
            self.say(200, json.dumps({"results": results}).encode())

    def do_POST(self):
        path, body = urlsplit(self.path), self.rfile.read(int(self.headers["Content-Length"]))
        self.server.asked.append((path.path, parse_qs(path.query), self.headers.get("Authorization"), body))
        if path.path == "/api/v2/query":
            self.say(*(self.server.answer if isinstance(self.server.answer, tuple) else (200, self.server.answer)))
            return
        status, said = self.server.writes.pop(0) if self.server.writes else (204, b"")
        self.say(status, said)

    def say(self, status, body):
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_):
        pass
