use std::collections::HashMap;
use std::io::{self, ErrorKind, Write};
use std::net::TcpStream;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use schemars::generate::SchemaSettings;
use serde::Deserialize;
use serde_json::{Value, json};
use tungstenite::handshake::derive_accept_key;
use tungstenite::protocol::{Role, WebSocketConfig};
use tungstenite::{Error, Message, WebSocket};

use super::LiveStatus;
use super::feed::{Changes, Feed, now_unix_ns};
use super::page::{self, Answer};
use super::request::Request;
use crate::recording::Channel;

// Foxglove's WebSocket protocol (github.com/foxglove/ws-protocol, docs/spec.md) as far as a source
// of data needs it: the server sends its name, advertises channels with their schemas, and sends
// the messages of the channels that a client subscribes to. It offers no other capability, and
// ignores all other requests.

/// Time after which a client that takes no bytes counts as gone.
pub(super) const STUCK_WITHIN: Duration = Duration::from_secs(5);

/// Names of the protocol: Foxglove's SDK uses the first, Lichtblick and others use the second,
/// which is older. The part of the protocol that is used here is the same under both names.
const SUBPROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];

/// Largest message of a client, bytes. A subscription to every channel has some hundred bytes.
pub(super) const MAX_CLIENT_MESSAGE_BYTES: usize = 1 << 16;

/// Largest number of bytes that wait for a slow client; further messages are dropped.
const MAX_WAITING_BYTES: usize = 1 << 21;

/// Time for which the connection waits for a message of the client before it sends the feed's
/// changes: about 30 times a second, enough for a screen.
const INTERVAL: Duration = Duration::from_millis(33);

/// Largest number of messages of a client in a second; a client that sends more is cut off.
pub(super) const MAX_MESSAGES_A_SECOND: u32 = 100;

/// Id of the channel with the [`LiveStatus`] of the command; the lower ids, from 1, belong to a
/// recording's channels.
const SESSION_CHANNEL: u64 = Channel::ALL.len() as u64 + 1;

/// Opcode of the protocol's binary message with data.
const MESSAGE_DATA: u8 = 1;

/// A request of a client that the server carries out. The server ignores all others, for which it
/// has announced no capability.
#[derive(Deserialize)]
#[serde(tag = "op", rename_all = "camelCase")]
enum ClientRequest {
    Subscribe {
        subscriptions: Vec<Subscription>,
    },
    #[serde(rename_all = "camelCase")]
    Unsubscribe {
        subscription_ids: Vec<u32>,
    },
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Subscription {
    id: u32,
    channel_id: u64,
}

/// An entry in the count of connections that need encoded messages, for as long as this value
/// exists.
struct Listening<'a>(&'a AtomicUsize);

impl<'a> Listening<'a> {
    fn new(listeners: &'a AtomicUsize) -> Self {
        listeners.fetch_add(1, Ordering::Relaxed);
        Self(listeners)
    }
}

impl Drop for Listening<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Answers a client that requests a WebSocket, and serves it until it goes, breaks a limit, or the
/// view closes.
pub(super) fn serve(feed: &Feed, mut stream: TcpStream, request: &Request, rest: Vec<u8>) {
    let offered = request.header("sec-websocket-protocol").unwrap_or_default();
    let chosen =
        SUBPROTOCOLS.into_iter().find(|it| offered.split(',').any(|name| name.trim() == *it));
    let (Some(protocol), Some(key), Some("13")) =
        (chosen, request.header("sec-websocket-key"), request.header("sec-websocket-version"))
    else {
        return page::send(&mut stream, &Answer::refusal("400 Bad Request"));
    };
    let accept = derive_accept_key(key.as_bytes());
    let head = format!(
        "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
         Sec-WebSocket-Accept: {accept}\r\nSec-WebSocket-Protocol: {protocol}\r\n\r\n"
    );
    let timed = stream
        .set_read_timeout(Some(INTERVAL))
        .and_then(|()| stream.set_write_timeout(Some(INTERVAL)));
    if timed.is_err() || stream.write_all(head.as_bytes()).is_err() {
        return;
    }
    let socket = WebSocket::from_partially_read(stream, rest, Role::Server, Some(limits()));
    let _listening = Listening::new(&feed.listeners);
    let mut client = Client {
        socket,
        subscriptions: HashMap::new(),
        new_channels: Vec::new(),
        stuck_since: None,
        second: Instant::now(),
        messages: 0,
    };
    // An error of this client ends only its own connection.
    if let Err(error) = client.follow(feed) {
        tracing::debug!("a live viewer is gone: {error}");
    }
}

/// The limits of a connection's memory.
fn limits() -> WebSocketConfig {
    WebSocketConfig::default()
        .max_message_size(Some(MAX_CLIENT_MESSAGE_BYTES))
        .max_frame_size(Some(MAX_CLIENT_MESSAGE_BYTES))
        .read_buffer_size(4096)
        .max_write_buffer_size(MAX_WAITING_BYTES)
}

struct Client {
    socket: WebSocket<TcpStream>,
    /// Id of the subscription by the id of its channel.
    subscriptions: HashMap<u64, u32>,
    /// Ids of channels that the client has just subscribed to and whose lasting message has not
    /// been sent.
    new_channels: Vec<u64>,
    /// Time since which the client has taken no bytes; `None` while it takes them.
    stuck_since: Option<Instant>,
    /// Beginning of the second in which `messages` are counted.
    second: Instant,
    /// Number of the client's messages in this second.
    messages: u32,
}

impl Client {
    fn follow(&mut self, feed: &Feed) -> Result<(), Error> {
        self.put(Message::text(server_info().to_string()))?;
        self.put(Message::text(advertisement().to_string()))?;
        let mut position = feed.position();
        let mut lasting = Changes::default();
        loop {
            let closes = feed.closed.load(Ordering::Relaxed);
            let changes = feed.since(&mut position);
            self.send(&changes)?;
            if closes {
                let _ = self.socket.close(None);
                return self.flush();
            }
            if changes.status.is_some() {
                lasting.status = changes.status;
            }
            if changes.rollout.is_some() {
                lasting.rollout = changes.rollout;
            }
            self.flush()?;
            // A client that writes all the time must not keep the feed and the end of the view
            // waiting.
            let until = Instant::now() + INTERVAL;
            while let Some(message) = self.receive()? {
                if let Message::Text(text) = message {
                    self.handle(&text);
                }
                if Instant::now() >= until {
                    break;
                }
            }
            for channel in std::mem::take(&mut self.new_channels) {
                self.send_lasting(channel, &lasting)?;
            }
        }
    }

    /// Sends the messages about the feed's changes. A client that takes no bytes misses the ticks.
    fn send(&mut self, changes: &Changes) -> Result<(), Error> {
        if changes.status.is_some() {
            self.send_lasting(SESSION_CHANNEL, changes)?;
        }
        if changes.rollout.is_some() {
            self.send_lasting(number(Channel::Scene), changes)?;
        }
        for tick in &changes.ticks {
            if self.stuck_since.is_some() {
                return Ok(());
            }
            for (channel, message) in &tick.messages {
                self.data(number(*channel), tick.time_ns, message)?;
            }
        }
        if let Some(end) = changes.end.as_ref().filter(|end| !end.safety.is_empty()) {
            self.data(number(Channel::Safety), end.time_ns, &end.safety)?;
        }
        Ok(())
    }

    /// Sends the lasting message of a channel, if it has one and `changes` contains it: the status
    /// or the scene. These change rarely, so a new subscriber gets the last one at once.
    fn send_lasting(&mut self, channel: u64, changes: &Changes) -> Result<(), Error> {
        if let (SESSION_CHANNEL, Some(status)) = (channel, &changes.status) {
            let message = serde_json::to_vec(status).unwrap_or_default();
            return self.data(channel, now_unix_ns(), &message);
        }
        if let Some(rollout) = &changes.rollout
            && channel == number(Channel::Scene)
        {
            return self.data(channel, rollout.time_ns, &rollout.scene);
        }
        Ok(())
    }

    fn data(&mut self, channel: u64, time_ns: u64, message: &[u8]) -> Result<(), Error> {
        let Some(subscription) = self.subscriptions.get(&channel) else { return Ok(()) };
        let mut bytes = Vec::with_capacity(13 + message.len());
        bytes.push(MESSAGE_DATA);
        bytes.extend(subscription.to_le_bytes());
        bytes.extend(time_ns.to_le_bytes());
        bytes.extend(message);
        self.put(Message::binary(bytes))
    }

    fn put(&mut self, message: Message) -> Result<(), Error> {
        match self.socket.write(message) {
            // The buffer has no room for this message, so the message is lost.
            Err(Error::WriteBufferFull(_)) => Ok(()),
            other => self.passed(other),
        }
    }

    fn flush(&mut self) -> Result<(), Error> {
        let flushed = self.socket.flush();
        if flushed.is_ok() {
            self.stuck_since = None;
        }
        self.passed(flushed)
    }

    /// Ignores the error of a client that takes no bytes, until it has taken none for
    /// [`STUCK_WITHIN`].
    fn passed(&mut self, result: Result<(), Error>) -> Result<(), Error> {
        match result {
            Err(Error::Io(error)) if is_waiting(&error) => {
                let since = *self.stuck_since.get_or_insert_with(Instant::now);
                if since.elapsed() < STUCK_WITHIN { Ok(()) } else { Err(Error::Io(error)) }
            }
            other => other,
        }
    }

    /// Returns the next message of the client; `None` if none comes within the read timeout.
    fn receive(&mut self) -> Result<Option<Message>, Error> {
        match self.socket.read() {
            Ok(message) => {
                if self.second.elapsed() >= Duration::from_secs(1) {
                    self.second = Instant::now();
                    self.messages = 0;
                }
                self.messages += 1;
                if self.messages > MAX_MESSAGES_A_SECOND {
                    return Err(Error::Io(io::Error::other("it sends too many messages")));
                }
                Ok(Some(message))
            }
            Err(Error::Io(error)) if is_waiting(&error) => Ok(None),
            Err(error) => Err(error),
        }
    }

    fn handle(&mut self, text: &str) {
        match serde_json::from_str(text) {
            Ok(ClientRequest::Subscribe { subscriptions }) => {
                for Subscription { id, channel_id } in subscriptions {
                    if (1..=SESSION_CHANNEL).contains(&channel_id) {
                        self.subscriptions.insert(channel_id, id);
                        self.new_channels.push(channel_id);
                    }
                }
            }
            Ok(ClientRequest::Unsubscribe { subscription_ids }) => {
                self.subscriptions.retain(|_, id| !subscription_ids.contains(id));
            }
            Err(_) => {}
        }
    }
}

fn is_waiting(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted)
}

/// Id of a recording's channel in the protocol, from 1 on.
fn number(channel: Channel) -> u64 {
    channel as u64 + 1
}

fn server_info() -> Value {
    json!({
        "op": "serverInfo",
        "name": concat!("qube-hil ", env!("CARGO_PKG_VERSION")),
        "capabilities": [],
        "metadata": {},
        "sessionId": format!("{}-{}", std::process::id(), now_unix_ns()),
    })
}

/// The message that advertises the channels with their schemas. JSON Schemas are sent as text, all
/// others in Base64, as the protocol requires.
fn advertisement() -> Value {
    let mut channels: Vec<Value> = Channel::ALL
        .into_iter()
        .map(|channel| {
            let schema = channel.schema();
            let data = match String::from_utf8(schema.data) {
                Ok(text) if schema.encoding == "jsonschema" => text,
                Ok(text) => BASE64_STANDARD.encode(text),
                Err(error) => BASE64_STANDARD.encode(error.into_bytes()),
            };
            json!({
                "id": number(channel),
                "topic": channel.topic(),
                "encoding": schema.message_encoding,
                "schemaName": schema.name,
                "schemaEncoding": schema.encoding,
                "schema": data,
            })
        })
        .collect();
    let schema = SchemaSettings::draft07().into_generator().into_root_schema_for::<LiveStatus>();
    channels.push(json!({
        "id": SESSION_CHANNEL,
        "topic": "/session",
        "encoding": "json",
        "schemaName": "qube.Session",
        "schemaEncoding": "jsonschema",
        "schema": schema.as_value().to_string(),
    }));
    json!({ "op": "advertise", "channels": channels })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A connection that takes no bytes.
    struct Stuck;

    impl io::Read for Stuck {
        fn read(&mut self, _: &mut [u8]) -> io::Result<usize> {
            Err(ErrorKind::WouldBlock.into())
        }
    }

    impl Write for Stuck {
        fn write(&mut self, _: &[u8]) -> io::Result<usize> {
            Err(ErrorKind::WouldBlock.into())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn the_bytes_that_wait_for_a_slow_client_stay_within_the_limit() {
        let mut socket = WebSocket::from_raw_socket(Stuck, Role::Server, Some(limits()));
        let message = vec![0; 1000];
        let mut waiting = 0;
        while !matches!(
            socket.write(Message::binary(message.clone())),
            Err(Error::WriteBufferFull(_))
        ) {
            waiting += message.len();
            assert!(waiting <= MAX_WAITING_BYTES, "{waiting} bytes wait");
        }
        // A message has a head of some bytes.
        assert!(waiting + 10 * message.len() > MAX_WAITING_BYTES, "only {waiting} bytes wait");
    }
}
