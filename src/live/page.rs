use std::fmt::Write as _;
use std::io::{ErrorKind, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::atomic::Ordering;
use std::thread;
use std::time::{Duration, Instant};

use serde::Serialize;

use super::feed::{Changes, Feed};

/// Interval at which the page receives the feed's changes.
const INTERVAL: Duration = Duration::from_millis(40);

/// Time without events after which a comment shows the client that the stream is alive.
const ALIVE: Duration = Duration::from_secs(5);

/// Time for which the view reads on after an answer before it closes the connection; the last read
/// may take as long again.
const LINGER: Duration = Duration::from_millis(500);

/// The content security policy of the page, which lets the page load scripts, styles and data from
/// this address alone, and images from `data:` URLs alone.
const CONTENT_POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; \
     img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// An HTTP response with a fixed body.
pub(super) struct Answer {
    status: &'static str,
    kind: &'static str,
    body: &'static str,
}

impl Answer {
    /// A refusal, whose text is its status.
    pub(super) fn refusal(status: &'static str) -> Self {
        Self::text(status, status)
    }

    pub(super) fn text(status: &'static str, body: &'static str) -> Self {
        Self { status, kind: "text/plain; charset=utf-8", body }
    }
}

/// The page or one of its parts; `None` if there is none at this path.
pub(super) fn asset(path: &str) -> Option<Answer> {
    let (kind, body) = match path {
        "/" => ("text/html; charset=utf-8", include_str!("assets/live.html")),
        "/live.css" => ("text/css; charset=utf-8", include_str!("assets/live.css")),
        "/report.css" => ("text/css; charset=utf-8", include_str!("../report/assets/report.css")),
        "/live.js" => ("text/javascript; charset=utf-8", include_str!("assets/live.js")),
        "/uPlot.css" => ("text/css; charset=utf-8", include_str!("../report/assets/uPlot.min.css")),
        "/uPlot.js" => {
            ("text/javascript; charset=utf-8", include_str!("../report/assets/uPlot.iife.min.js"))
        }
        _ => return None,
    };
    Some(Answer { status: "200 OK", kind, body })
}

/// Sends an answer, after which the connection ends.
pub(super) fn send(stream: &mut TcpStream, answer: &Answer) {
    let Answer { status, kind, body } = answer;
    let head = head(status, kind, &format!("Content-Length: {}\r\n", body.len()));
    let sent = stream.write_all(head.as_bytes()).and_then(|()| stream.write_all(body.as_bytes()));
    if sent.is_ok() && stream.shutdown(Shutdown::Write).is_ok() {
        drain(stream);
    }
    // A client that is gone needs no answer.
}

/// Reads and discards, for up to 1 s, the bytes that a client sends after its request. If a
/// connection is closed with unread bytes, the system resets it, and the client may lose its
/// answer.
fn drain(stream: &mut TcpStream) {
    let until = Instant::now() + LINGER;
    let mut part = [0; 4096];
    while Instant::now() < until {
        let read = stream.set_read_timeout(Some(LINGER)).and_then(|()| stream.read(&mut part));
        if !matches!(read, Ok(1..)) {
            return;
        }
    }
}

fn head(status: &str, kind: &str, more: &str) -> String {
    format!(
        "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\n{more}Connection: close\r\nCache-Control: no-store\r\n\
         Content-Security-Policy: {CONTENT_POLICY}\r\nX-Content-Type-Options: nosniff\r\n\
         Referrer-Policy: no-referrer\r\nCross-Origin-Resource-Policy: same-origin\r\n\r\n"
    )
}

/// Sends the name `server` of this view and the feed's changes as server-sent events until the
/// client goes or takes no more bytes, or the view closes.
pub(super) fn events(feed: &Feed, server: &str, mut stream: TcpStream) {
    let mut started = head("200 OK", "text/event-stream", "");
    event(&mut started, "server", &server);
    if stream.write_all(started.as_bytes()).is_err() || stream.set_nonblocking(false).is_err() {
        return;
    }
    let mut position = feed.position();
    let mut last_sent = Instant::now();
    loop {
        let closes = feed.closed.load(Ordering::Relaxed);
        let mut text = String::new();
        write_events(&mut text, &feed.since(&mut position));
        if text.is_empty() && last_sent.elapsed() >= ALIVE {
            text.push_str(": alive\n\n");
        }
        if !text.is_empty() {
            last_sent = Instant::now();
            if stream.write_all(text.as_bytes()).is_err() {
                return;
            }
        }
        if closes || is_gone(&stream) {
            return;
        }
        thread::sleep(INTERVAL);
    }
}

/// Returns whether the client has closed the connection or the stream fails, and leaves the stream
/// in blocking mode.
fn is_gone(stream: &TcpStream) -> bool {
    let looked = stream.set_nonblocking(true).and_then(|()| stream.peek(&mut [0]));
    let is_gone = match looked {
        Ok(count) => count == 0,
        Err(error) => !matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted),
    };
    is_gone || stream.set_nonblocking(false).is_err()
}

fn write_events(text: &mut String, changes: &Changes) {
    if let Some(status) = &changes.status {
        event(text, "status", status);
    }
    if let Some(rollout) = &changes.rollout {
        event(text, "rollout", &**rollout);
    }
    if changes.lost > 0 {
        event(text, "lost", &changes.lost);
    }
    if !changes.ticks.is_empty() {
        let points: Vec<_> = changes.ticks.iter().map(|tick| tick.point).collect();
        event(text, "ticks", &points);
    }
    if let Some(end) = &changes.end {
        event(text, "end", &**end);
    }
}

/// Adds a server-sent event. The data stay on one line, because compact JSON has no line breaks and
/// escapes those in strings.
fn event<T: Serialize>(text: &mut String, name: &str, data: &T) {
    if let Ok(data) = serde_json::to_string(data) {
        // Writing to a String cannot fail.
        let _ = write!(text, "event: {name}\ndata: {data}\n\n");
    }
}
