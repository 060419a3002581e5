"""A web server and a mail server on loopback that record requests, and refuse on demand."""

from __future__ import annotations

import json
import socketserver
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class _Tcp(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = False

    def handle_error(self, request, client_address):
        """Ignore a client that disconnects: no traceback."""


class _Started:
    def _start(self, server):
        self._server = server
        self.port = server.server_address[1]
        self._thread = threading.Thread(target=server.serve_forever, args=(0.02,), name="stand-in")
        self._thread.start()

    def close(self):
        if self._thread.is_alive():
            self._server.shutdown()
            self._thread.join()
            self._server.server_close()


class WebServer(_Started):
    """`posts` holds (path, headers, document); context: for TLS."""

    def __init__(self, port=0, context=None):
        self.posts, self.answer, self.location = [], 204, "/elsewhere"
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self):
                body = self.rfile.read(int(self.headers["Content-Length"]))
                outer.posts.append((self.path, dict(self.headers), json.loads(body)))
                self.send_response(outer.answer)
                if outer.answer == 302:
                    self.send_header("Location", outer.location)
                self.send_header("Content-Length", "0")
                self.end_headers()

            def do_GET(self):
                outer.posts.append(("GET", {}, {}))
                self.send_response(200)
                self.end_headers()

            def log_message(self, *_):
                pass

        server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        if context is not None:
            server.socket = context.wrap_socket(server.socket, server_side=True)
        self._start(server)


class MailServer(_Started):
    """The part of SMTP that smtplib uses; `letters` holds the text of each e-mail."""

    def __init__(self, port=0, context=None):
        self.letters, self.logins, self.login_answer = [], [], "235 yes"
        outer = self

        class Handler(socketserver.StreamRequestHandler):
            def say(self, text):
                self.wfile.write(text.encode() + b"\r\n")
                self.wfile.flush()

            def handle(self):
                secure = False
                self.say("220 stand-in")
                while words := self.rfile.readline().decode().split():
                    word = words[0].upper()
                    if word == "EHLO":
                        more = "250-STARTTLS\r\n" if context and not secure else ""
                        self.say(f"250-stand-in\r\n{more}250 AUTH PLAIN")
                    elif word == "STARTTLS":
                        self.say("220 go")
                        self.connection = context.wrap_socket(self.connection, server_side=True)
                        self.rfile = self.connection.makefile("rb")
                        self.wfile = self.connection.makefile("wb")
                        secure = True
                    elif word == "AUTH":
                        outer.logins.append((words, secure))
                        self.say(outer.login_answer)
                    elif word == "DATA":
                        self.say("354 go on")
                        lines = []
                        while (line := self.rfile.readline().decode()) != ".\r\n":
                            lines.append(line)
                        outer.letters.append("".join(lines))
                        self.say("250 taken")
                    elif word == "QUIT":
                        self.say("221 bye")
                        break
                    else:
                        self.say("250 yes")
                if secure:
                    self.rfile.close()
                    self.wfile.close()
                    self.connection.close()

        self._start(_Tcp(("127.0.0.1", port), Handler))
