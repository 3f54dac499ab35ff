use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use prost_reflect::{DescriptorPool, DynamicMessage};
use serde_json::{Value, json};
use tungstenite::client::IntoClientRequest;
use tungstenite::{Message, WebSocket};

use super::connection::{MAX_CONNECTIONS, MAX_VIEWERS};
use super::foxglove::{MAX_CLIENT_MESSAGE_BYTES, MAX_MESSAGES_A_SECOND};
use super::request::MAX_HEAD_BYTES;
use super::{LiveError, LiveSettings, LiveView};
use crate::recording::samples::{header, outcome, tick};
use crate::recording::{Channel, VIRTUAL_EPOCH_UNIX_NS, Viewer};
use crate::telemetry::TickRecord;

/// A view on a free port, and a flag that is set once a client requests a stop.
fn view() -> (LiveView, Arc<AtomicBool>) {
    let stopped = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&stopped);
    let address = "127.0.0.1:0".parse().unwrap();
    let settings = LiveSettings { address, origins: Vec::new() };
    (LiveView::serve(&settings, move |_| flag.store(true, Ordering::Relaxed)).unwrap(), stopped)
}

fn connect(address: SocketAddr) -> TcpStream {
    let stream = TcpStream::connect(address).unwrap();
    // With this limit, a read of bytes that never come fails the test instead of blocking it.
    stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
    stream
}

/// Sends a request, and returns everything that comes until the view closes the connection.
fn ask(address: SocketAddr, request: &str) -> String {
    let mut stream = connect(address);
    stream.write_all(request.as_bytes()).unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    String::from_utf8(answer).unwrap()
}

fn get(address: SocketAddr, path: &str, more: &str) -> String {
    ask(address, &format!("GET {path} HTTP/1.1\r\nHost: {address}\r\n{more}\r\n"))
}

fn status_of(answer: &str) -> &str {
    answer.split("\r\n").next().unwrap().strip_prefix("HTTP/1.1 ").unwrap()
}

/// A client of Foxglove's protocol.
struct Listener {
    socket: WebSocket<TcpStream>,
    channels: Vec<Value>,
}

impl Listener {
    fn new(address: SocketAddr, protocol: &str) -> Self {
        let mut request = format!("ws://{address}/").into_client_request().unwrap();
        request.headers_mut().insert("Sec-WebSocket-Protocol", protocol.parse().unwrap());
        let (socket, answer) = tungstenite::client(request, connect(address)).unwrap();
        assert!(protocol.contains(answer.headers()["Sec-WebSocket-Protocol"].to_str().unwrap()));
        let mut listener = Self { socket, channels: Vec::new() };
        let info = listener.text();
        assert_eq!((&info["op"], &info["capabilities"]), (&json!("serverInfo"), &json!([])));
        let advertisement = listener.text();
        assert_eq!(advertisement["op"], "advertise");
        listener.channels = advertisement["channels"].as_array().unwrap().clone();
        listener
    }

    fn text(&mut self) -> Value {
        match self.socket.read().unwrap() {
            Message::Text(text) => serde_json::from_str(&text).unwrap(),
            other => panic!("{other:?}"),
        }
    }

    fn channel(&self, topic: &str) -> &Value {
        self.channels.iter().find(|channel| channel["topic"] == topic).unwrap()
    }

    /// Subscribes to these channels, under the numbers 1, 2, and so on.
    fn subscribe(&mut self, topics: &[&str]) {
        let subscriptions: Vec<Value> = topics
            .iter()
            .zip(1..)
            .map(|(topic, id)| json!({ "id": id, "channelId": self.channel(topic)["id"] }))
            .collect();
        let request = json!({ "op": "subscribe", "subscriptions": subscriptions });
        self.socket.send(Message::text(request.to_string())).unwrap();
    }

    /// The next message with data: its subscription, its time, and its bytes.
    fn data(&mut self) -> (u32, u64, Vec<u8>) {
        match self.socket.read().unwrap() {
            Message::Binary(bytes) => {
                assert_eq!(bytes[0], 1);
                let subscription = u32::from_le_bytes(bytes[1..5].try_into().unwrap());
                let time_ns = u64::from_le_bytes(bytes[5..13].try_into().unwrap());
                (subscription, time_ns, bytes[13..].to_vec())
            }
            other => panic!("{other:?}"),
        }
    }
}

/// Connects a client, subscribes to the scene and these channels, and waits for the scene, which
/// shows that the view knows the subscription.
fn listening(address: SocketAddr, topics: &[&str]) -> Listener {
    let mut listener = Listener::new(address, "foxglove.sdk.v1");
    listener.subscribe(&[&["/scene"], topics].concat());
    assert_eq!(listener.data().0, 1);
    listener
}

/// Begins a rollout and waits until the view shows it.
fn begun(view: &LiveView) -> Arc<dyn Viewer> {
    let viewer = view.viewer();
    viewer.begins(&header(), VIRTUAL_EPOCH_UNIX_NS);
    let mut stream = connect(view.address());
    let request = format!("GET /events HTTP/1.1\r\nHost: {}\r\n\r\n", view.address());
    stream.write_all(request.as_bytes()).unwrap();
    until(&mut stream, "event: rollout");
    viewer
}

/// Reads until `text` has come; returns everything that was read.
fn until(stream: &mut TcpStream, text: &str) -> String {
    let mut all = Vec::new();
    let mut part = [0; 4096];
    while !String::from_utf8_lossy(&all).contains(text) {
        let count = stream.read(&mut part).unwrap();
        assert!(count > 0, "{text} did not come: {}", String::from_utf8_lossy(&all));
        all.extend(&part[..count]);
    }
    String::from_utf8_lossy(&all).into_owned()
}

#[test]
fn foxglove_gets_the_messages_of_a_recording() {
    let (view, _) = view();
    let viewer = begun(&view);
    for protocol in ["foxglove.sdk.v1", "foxglove.websocket.v1", "x, foxglove.websocket.v1"] {
        let listener = Listener::new(view.address(), protocol);
        let topics: Vec<_> =
            listener.channels.iter().map(|it| it["topic"].as_str().unwrap()).collect();
        let recorded =
            ["/measurement", "/state", "/command", "/safety", "/tf", "/timing", "/scene"];
        assert_eq!(topics, [&recorded[..], &["/session"]].concat());
    }
    let mut listener = listening(view.address(), &["/tf", "/state", "/session"]);
    let (_, _, message) = listener.data();
    let status: Value = serde_json::from_slice(&message).unwrap();
    assert_eq!(status["ended"], false);
    viewer.ticked(&tick(0));
    viewer.ticked(&tick(1));
    let mut seen = Vec::new();
    for _ in 0..4 {
        let (subscription, time_ns, message) = listener.data();
        seen.push((subscription, time_ns - VIRTUAL_EPOCH_UNIX_NS));
        if subscription == 3 {
            let state: Value = serde_json::from_slice(&message).unwrap();
            let number = (time_ns - VIRTUAL_EPOCH_UNIX_NS) / 10_000_000;
            assert_eq!(state["theta_rad"], tick(number as u32).state.theta);
        } else {
            let channel = listener.channel("/tf");
            let schema = BASE64_STANDARD.decode(channel["schema"].as_str().unwrap()).unwrap();
            let pool = DescriptorPool::decode(&*schema).unwrap();
            let descriptor = pool.get_message_by_name("foxglove.FrameTransforms").unwrap();
            let frames = DynamicMessage::decode(descriptor, &*message).unwrap();
            let list = frames.get_field_by_name("transforms").unwrap();
            assert_eq!(list.as_list().unwrap().len(), 2);
        }
    }
    seen.sort_unstable();
    assert_eq!(seen, [(2, 0), (2, 10_000_000), (3, 0), (3, 10_000_000)]);
    view.update_status(|status| status.doing = "something else".to_owned());
    let (subscription, _, message) = listener.data();
    assert_eq!((subscription, &message[..1]), (4, &b"{"[..]));
}

#[test]
fn the_last_message_about_safety_has_the_ending() {
    let (view, _) = view();
    let viewer = begun(&view);
    let mut listener = listening(view.address(), &["/safety"]);
    viewer.ticked(&tick(0));
    viewer.ended(Some(&outcome()));
    let endings = [(); 2].map(|()| {
        let (_, time_ns, message) = listener.data();
        assert_eq!(time_ns, VIRTUAL_EPOCH_UNIX_NS);
        let safety: Value = serde_json::from_slice(&message).unwrap();
        safety["ending_number"].as_u64()
    });
    assert_eq!(endings, [None, Some(2)], "the last message lacks the ending");
}

#[test]
fn a_viewer_that_writes_all_the_time_gets_the_feed_too() {
    let (view, _) = view();
    let viewer = begun(&view);
    let mut listener = listening(view.address(), &["/timing"]);
    // 67 messages a second: fewer than a viewer may send, and never 33 ms without one.
    let mut busy = listener.socket.get_ref().try_clone().unwrap();
    let ended = Arc::new(AtomicBool::new(false));
    let seen = Arc::clone(&ended);
    let writer = std::thread::spawn(move || {
        // These bytes are a masked ping without data. On a busy computer 1000 of them take longer,
        // as everything does, so they serve as the deadline.
        for _ in 0..1000 {
            let is_written = busy.write_all(&[0x89, 0x80, 0, 0, 0, 0]).is_ok();
            if !is_written || seen.load(Ordering::Relaxed) {
                break;
            }
            std::thread::sleep(Duration::from_millis(15));
        }
    });
    let mut got = false;
    listener.socket.get_mut().set_read_timeout(Some(Duration::from_millis(100))).unwrap();
    while !got && !writer.is_finished() {
        viewer.ticked(&tick(0));
        got = matches!(listener.socket.read(), Ok(Message::Binary(_)));
    }
    ended.store(true, Ordering::Relaxed);
    writer.join().unwrap();
    assert!(got, "no tick came between 1000 messages");
}

#[test]
fn a_viewer_that_stops_reading_loses_messages_and_delays_nobody() {
    let (view, _) = view();
    let viewer = begun(&view);
    // The first client reads nothing until the view has closed.
    let every = ["/measurement", "/state", "/command", "/safety", "/tf", "/timing"];
    let mut stuck = listening(view.address(), &every);
    let mut reading = listening(view.address(), &["/timing"]);
    let sent = 20_000;
    let reader = std::thread::spawn(move || {
        let mut last = 0;
        let mut count = 0;
        while last < u64::from(sent) - 1 {
            let (_, time_ns, _) = reading.data();
            last = (time_ns - VIRTUAL_EPOCH_UNIX_NS) / 10_000_000;
            count += 1;
        }
        count
    });
    for number in 0..sent {
        viewer.ticked(&tick(number));
        if number % 64 == 0 {
            std::thread::sleep(Duration::from_millis(5));
        }
    }
    // Some ticks may be dropped, so the last one is sent until the reader has it.
    while !reader.is_finished() {
        viewer.ticked(&tick(sent - 1));
        std::thread::sleep(Duration::from_millis(20));
    }
    assert!(reader.join().unwrap() > 0);
    viewer.ended(Some(&outcome()));
    drop(view);
    // The client that did not read gets only the messages that the system has kept for it.
    let mut count = 0_u32;
    let end = loop {
        match stuck.socket.read() {
            Ok(Message::Binary(_)) => count += 1,
            Ok(_) => {}
            Err(error) => break error,
        }
    };
    assert!(count < sent * 6, "{end}: it got all {count} messages");
}

#[test]
fn the_page_loads_nothing_from_elsewhere() {
    let (view, _) = view();
    for path in ["/", "/live.js", "/live.css", "/report.css", "/uPlot.js", "/uPlot.css"] {
        let answer = get(view.address(), path, "");
        assert_eq!(status_of(&answer), "200 OK", "{path}");
        let (head, body) = answer.split_once("\r\n\r\n").unwrap();
        assert!(head.contains("Content-Security-Policy: default-src 'none'; script-src 'self';"));
        assert!(head.contains(&format!("Content-Length: {}\r\n", body.len())), "{path}");
        if path == "/" {
            assert!(!body.contains("http") && body.contains("id=\"stop\""), "{body}");
        }
    }
    assert_eq!(status_of(&get(view.address(), "/../Cargo.toml", "")), "404 Not Found");
    assert_eq!(status_of(&get(view.address(), "/?x=1", "")), "200 OK");
}

#[test]
fn the_page_receives_status_rollout_ticks_and_end() {
    let (view, _) = view();
    let viewer = begun(&view);
    let mut stream = connect(view.address());
    let request = format!("GET /events HTTP/1.1\r\nHost: {}\r\n\r\n", view.address());
    stream.write_all(request.as_bytes()).unwrap();
    let begins = until(&mut stream, "\"theta_limit_rad\":2.3");
    assert!(begins.contains("text/event-stream") && begins.contains("event: status\n"), "{begins}");
    assert!(begins.contains("\"policy\":\"nominal\""), "{begins}");
    let mut broken = tick(3);
    broken.state.theta = f64::NAN;
    viewer.ticked(&tick(2));
    viewer.ticked(&broken);
    let ticks = until(&mut stream, "0.01,null,");
    assert!(ticks.contains("event: ticks\ndata: [[0.0,"), "{ticks}");
    viewer.ended(Some(&outcome()));
    until(&mut stream, "\"ending\":\"left the box by theta\"");
    view.update_status(|status| status.doing = "line\nbreak".to_owned());
    until(&mut stream, "line\\nbreak");
    drop(view);
    until(&mut stream, "\"ended\":true");
}

#[test]
fn two_views_at_one_address_have_different_names() {
    let (first, _) = view();
    let address = first.address();
    let server = || {
        let mut stream = connect(address);
        let request = format!("GET /events HTTP/1.1\r\nHost: {address}\r\n\r\n");
        stream.write_all(request.as_bytes()).unwrap();
        let text = until(&mut stream, "event: status");
        let (_, events) = text.split_once("\r\n\r\n").unwrap();
        // The name comes first, because the page drops everything that it has from another view.
        let data = events.strip_prefix("event: server\ndata: \"").unwrap();
        data.split_once("\"\n\n").unwrap().0.to_owned()
    };
    let of_first = server();
    assert_eq!(of_first, server());
    drop(first);
    let settings = LiveSettings { address, origins: Vec::new() };
    let _second = LiveView::serve(&settings, |_| {}).unwrap();
    assert_ne!(of_first, server());
}

#[test]
fn a_stop_by_a_foreign_page_or_without_its_header_is_refused() {
    let (view, stopped) = view();
    let address = view.address();
    let post = |host: &str, more: &str| {
        ask(address, &format!("POST /stop HTTP/1.1\r\nHost: {host}\r\n{more}\r\n"))
    };
    let own = address.to_string();
    for (host, more, expected) in [
        (own.as_str(), "", "403 Forbidden"),
        (&own, "X-Qube-Hil: go\r\n", "403 Forbidden"),
        (&own, "X-Qube-Hil: stop\r\nOrigin: https://evil.example\r\n", "403 Forbidden"),
        (&own, "X-Qube-Hil: stop\r\nOrigin: http://localhost:8080\r\n", "403 Forbidden"),
        (&own, "X-Qube-Hil: stop\r\nOrigin: null\r\n", "403 Forbidden"),
        ("evil.example:80", "X-Qube-Hil: stop\r\n", "421 Misdirected Request"),
    ] {
        assert_eq!(status_of(&post(host, more)), expected, "{host} {more}");
    }
    assert_eq!(status_of(&get(address, "/stop", "X-Qube-Hil: stop\r\n")), "404 Not Found");
    assert!(!stopped.load(Ordering::Relaxed));
    let more = format!("X-Qube-Hil: stop\r\nOrigin: http://{own}\r\nContent-Length: 0\r\n");
    assert_eq!(status_of(&post(&own, &more)), "200 OK");
    assert!(stopped.load(Ordering::Relaxed));
    let mut stream = connect(address);
    stream.write_all(format!("GET /events HTTP/1.1\r\nHost: {own}\r\n\r\n").as_bytes()).unwrap();
    until(&mut stream, "\"stop_requested\":true");
}

#[test]
fn a_stop_that_was_requested_elsewhere_is_shown() {
    let (view, stopped) = view();
    let viewer = begun(&view);
    let mut stream = connect(view.address());
    let request = format!("GET /events HTTP/1.1\r\nHost: {}\r\n\r\n", view.address());
    stream.write_all(request.as_bytes()).unwrap();
    until(&mut stream, "\"stop_requested\":false");
    viewer.ticked(&TickRecord { stop_requested: true, ..tick(2) });
    until(&mut stream, "\"stop_requested\":true");
    assert!(!stopped.load(Ordering::Relaxed));
}

#[test]
fn foreign_pages_get_no_feed() {
    let (view, _) = view();
    let upgrade = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n\
                   Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n";
    for origin in ["https://evil.example", "null", "http://evil.example:8765"] {
        let foreign = format!("{upgrade}Origin: {origin}\r\n");
        assert_eq!(status_of(&get(view.address(), "/", &foreign)), "403 Forbidden", "{origin}");
        let foreign = format!("Origin: {origin}\r\n");
        assert_eq!(status_of(&get(view.address(), "/events", &foreign)), "403 Forbidden");
    }
    // An image of a foreign page comes without the header `Origin`.
    let image =
        "Sec-Fetch-Site: cross-site\r\nSec-Fetch-Mode: no-cors\r\nSec-Fetch-Dest: image\r\n";
    assert_eq!(status_of(&get(view.address(), "/events", image)), "403 Forbidden");
    let other = upgrade.replace("foxglove.sdk.v1", "chat");
    assert_eq!(status_of(&get(view.address(), "/", &other)), "400 Bad Request");
}

#[test]
fn bad_clients_do_not_disturb_other_clients() {
    let (view, _) = view();
    let viewer = begun(&view);
    let address = view.address();
    let mut good = listening(address, &["/timing"]);

    let endless =
        format!("GET / HTTP/1.1\r\nHost: {address}\r\nX: {}", "x".repeat(2 * MAX_HEAD_BYTES));
    let mut stream = connect(address);
    // The view may close the connection before it has read everything.
    let _ = stream.write_all(endless.as_bytes());
    let mut answer = String::new();
    let _ = stream.read_to_string(&mut answer);
    assert!(answer.is_empty() || status_of(&answer).starts_with("431"), "{answer}");
    let many = format!("GET / HTTP/1.1\r\nHost: {address}\r\n{}\r\n", "X: y\r\n".repeat(200));
    assert_eq!(status_of(&ask(address, &many)), "431 Request Header Fields Too Large");
    assert_eq!(status_of(&ask(address, "\0\0\0\0\r\n\r\n")), "400 Bad Request");
    assert_eq!(status_of(&ask(address, "GET / HTTP/1.1\r\n\r\n")), "421 Misdirected Request");

    // One frame claims a terabyte, the other is one byte too large.
    for length in [1_u64 << 40, MAX_CLIENT_MESSAGE_BYTES as u64 + 1] {
        let mut huge = Listener::new(address, "foxglove.sdk.v1");
        let mut frame = vec![0x82, 0xff];
        frame.extend(length.to_be_bytes());
        frame.extend([0; 4]);
        huge.socket.get_mut().write_all(&frame).unwrap();
        assert!(closes(&mut huge), "a client may send a message of {length} bytes");
    }
    let mut flood = Listener::new(address, "foxglove.sdk.v1");
    for _ in 0..10 * MAX_MESSAGES_A_SECOND {
        if flood.socket.send(Message::text("{\"op\":\"what\"}")).is_err() {
            break;
        }
    }
    assert!(closes(&mut flood), "a client may send too many messages");
    let mut garbage = listening(address, &["/timing"]);
    for text in [
        "",
        "[",
        "{\"op\":\"subscribe\"}",
        "{\"op\":\"subscribe\",\"subscriptions\":[{\"id\":9,\"channelId\":99}]}",
    ] {
        garbage.socket.send(Message::text(text)).unwrap();
    }
    garbage.socket.send(Message::binary(vec![1, 2, 3])).unwrap();

    viewer.ticked(&tick(5));
    assert_eq!(good.data().0, 2);
    assert_eq!(garbage.data().0, 2, "invalid messages are not ignored");
}

/// Returns whether the view ends the connection, and ignores the messages that come before the end.
fn closes(listener: &mut Listener) -> bool {
    loop {
        match listener.socket.read() {
            Ok(_) => {}
            Err(tungstenite::Error::Io(error)) => {
                return !matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut);
            }
            Err(_) => return true,
        }
    }
}

#[test]
fn half_open_connections_take_a_bounded_number_of_places_and_give_them_back() {
    let (view, _) = view();
    let address = view.address();
    let silent: Vec<TcpStream> = (0..2 * MAX_CONNECTIONS).map(|_| connect(address)).collect();
    // The connections beyond the largest number are closed at once; the others may wait for a
    // while.
    let mut part = [0];
    let mut last = &silent[2 * MAX_CONNECTIONS - 1];
    assert!(matches!(last.read(&mut part), Ok(0) | Err(_)));
    let closed = silent.iter().filter(|stream| {
        stream.set_nonblocking(true).unwrap();
        !matches!(stream.peek(&mut [0]), Err(error) if error.kind() == ErrorKind::WouldBlock)
    });
    assert!(closed.count() >= MAX_CONNECTIONS);
    drop(silent);
    let begun = Instant::now();
    loop {
        assert!(begun.elapsed() < Duration::from_secs(60), "no place is given back");
        let mut stream = connect(address);
        let request = format!("GET / HTTP/1.1\r\nHost: {address}\r\n\r\n");
        let mut answer = String::new();
        let asked = stream.write_all(request.as_bytes());
        if asked.is_ok() && stream.read_to_string(&mut answer).is_ok() && !answer.is_empty() {
            assert_eq!(status_of(&answer), "200 OK");
            break;
        }
    }
}

#[test]
fn a_stop_arrives_while_all_places_for_viewers_are_taken() {
    let (view, stopped) = view();
    let address = view.address();
    let events = format!("GET /events HTTP/1.1\r\nHost: {address}\r\n\r\n");
    let watch = || {
        let mut stream = connect(address);
        stream.write_all(events.as_bytes()).unwrap();
        stream
    };
    let mut viewers: Vec<TcpStream> = (0..MAX_VIEWERS).map(|_| watch()).collect();
    viewers.iter_mut().for_each(|viewer| drop(until(viewer, "event: status")));
    // Later viewers get no answer, so that a browser tries again.
    for mut late in (0..MAX_CONNECTIONS).map(|_| watch()) {
        assert!(matches!(late.read(&mut [0]), Ok(0) | Err(_)));
    }
    let upgrade = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n\
                   Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n";
    assert_eq!(get(address, "/", upgrade), "");
    assert_eq!(status_of(&get(address, "/", "")), "200 OK");
    let stop = format!("POST /stop HTTP/1.1\r\nHost: {address}\r\nX-Qube-Hil: stop\r\n\r\n");
    assert_eq!(status_of(&ask(address, &stop)), "200 OK");
    assert!(stopped.load(Ordering::Relaxed));
    // A viewer that goes frees its place.
    drop(viewers);
    let mut answer = 0;
    let begun = Instant::now();
    while answer == 0 {
        assert!(begun.elapsed() < Duration::from_secs(60), "no place becomes free");
        answer = watch().read(&mut [0]).unwrap_or(0);
    }
}

#[test]
fn an_address_in_use_is_named() {
    let (view, _) = view();
    let settings = LiveSettings { address: view.address(), origins: Vec::new() };
    let again = LiveView::serve(&settings, |_| {});
    let Err(LiveError::Address { address, .. }) = again else {
        panic!("two views listen on one address")
    };
    assert_eq!(address, view.address());
}

/// Tests that each panel of the layout for Foxglove and Lichtblick is placed once and shows fields
/// that exist.
#[test]
fn the_layout_shows_fields_that_the_channels_have() {
    let layout: Value =
        serde_json::from_str(include_str!("../../scripts/foxglove-layout.json")).unwrap();
    let mut placed = Vec::new();
    let mut waiting = vec![&layout["layout"]];
    while let Some(place) = waiting.pop() {
        match place.as_str() {
            Some(panel) => placed.push(panel),
            None => waiting.extend([&place["first"], &place["second"]]),
        }
    }
    let panels = layout["configById"].as_object().unwrap();
    placed.sort_unstable();
    assert_eq!(placed, panels.keys().map(String::as_str).collect::<Vec<_>>());
    let mut paths = Vec::new();
    for panel in panels.values() {
        paths.extend(panel["path"].as_str());
        let several = panel["paths"].as_array().into_iter().flatten();
        paths.extend(several.map(|path| path["value"].as_str().unwrap()));
    }
    assert!(paths.len() >= 8, "{paths:?}");
    for path in paths {
        let (topic, field) = path.split_once('.').unwrap();
        let channel = Channel::ALL.into_iter().find(|it| it.topic() == topic).unwrap();
        let schema: Value = serde_json::from_slice(&channel.schema().data).unwrap();
        assert!(schema["properties"].get(field).is_some(), "{path}");
    }
}
