use std::io::{self, Read};
use std::net::TcpStream;
use std::time::{Duration, Instant};

/// Number of bytes after which a request whose head is still incomplete is refused.
pub(super) const MAX_HEAD_BYTES: usize = 8192;

/// Largest number of headers.
const MAX_HEADERS: usize = 64;

/// Time within which the whole head must arrive.
const HEAD_WITHIN: Duration = Duration::from_secs(5);

/// The head of an HTTP request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Request {
    pub(super) method: String,
    /// Path without its query.
    pub(super) path: String,
    headers: Vec<(String, String)>,
}

/// The reason why no request was read.
#[derive(Debug)]
pub(super) enum BadRequest {
    /// The client has gone, or is too slow.
    Gone,
    /// The head is too long, or has too many headers.
    TooLarge,
    /// The bytes are not an HTTP request.
    Malformed,
}

impl Request {
    /// The value of a header; `name` is in lower case. `None` if the header is absent or occurs
    /// several times.
    pub(super) fn header(&self, name: &str) -> Option<&str> {
        let mut found = self.headers.iter().filter(|(header, _)| header == name);
        match (found.next(), found.next()) {
            (Some((_, value)), None) => Some(value),
            _ => None,
        }
    }

    /// Returns whether the request has a header of this name.
    pub(super) fn has(&self, name: &str) -> bool {
        self.headers.iter().any(|(header, _)| header == name)
    }

    /// Returns whether the client requests a WebSocket.
    pub(super) fn is_upgrade(&self) -> bool {
        self.header("upgrade").is_some_and(|value| value.eq_ignore_ascii_case("websocket"))
    }

    /// Reads a head, and returns it with the bytes that followed it.
    pub(super) fn read(stream: &mut TcpStream) -> Result<(Self, Vec<u8>), BadRequest> {
        let until = Instant::now() + HEAD_WITHIN;
        let mut bytes = Vec::new();
        let mut part = [0; 1024];
        loop {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() || stream.set_read_timeout(Some(left)).is_err() {
                return Err(BadRequest::Gone);
            }
            match stream.read(&mut part) {
                Ok(0) => return Err(BadRequest::Gone),
                Ok(count) => bytes.extend(&part[..count]),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                Err(_) => return Err(BadRequest::Gone),
            }
            if let Some((request, length)) = Self::parse(&bytes)? {
                return Ok((request, bytes.split_off(length)));
            }
            if bytes.len() > MAX_HEAD_BYTES {
                return Err(BadRequest::TooLarge);
            }
        }
    }

    /// Parses the request in the bytes, and returns it with the length of its head; `None` while
    /// bytes are missing.
    pub(super) fn parse(bytes: &[u8]) -> Result<Option<(Self, usize)>, BadRequest> {
        let mut headers = [httparse::EMPTY_HEADER; MAX_HEADERS];
        let mut parsed = httparse::Request::new(&mut headers);
        let length = match parsed.parse(bytes) {
            Ok(httparse::Status::Complete(length)) => length,
            Ok(httparse::Status::Partial) => return Ok(None),
            Err(httparse::Error::TooManyHeaders) => return Err(BadRequest::TooLarge),
            Err(_) => return Err(BadRequest::Malformed),
        };
        let (Some(method), Some(target)) = (parsed.method, parsed.path) else {
            return Err(BadRequest::Malformed);
        };
        let text = |header: &httparse::Header<'_>| {
            let value = std::str::from_utf8(header.value).ok()?;
            Some((header.name.to_ascii_lowercase(), value.trim().to_owned()))
        };
        let headers = parsed.headers.iter().map(text).collect::<Option<_>>();
        let request = Self {
            method: method.to_owned(),
            path: target.split('?').next().unwrap_or_default().to_owned(),
            headers: headers.ok_or(BadRequest::Malformed)?,
        };
        Ok(Some((request, length)))
    }
}
