use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::feed::Feed;
use super::foxglove::{self, STUCK_WITHIN};
use super::origin::{Admission, Refusal};
use super::page::{self, Answer};
use super::request::{BadRequest, Request};

/// Largest number of simultaneous connections from this computer, and likewise from all other
/// computers together.
pub(super) const MAX_CONNECTIONS: usize = 24;

/// Largest number of those connections that may be viewers, whose connections stay open. The other
/// connections are for requests that end soon, so that a stop arrives even if all places for
/// viewers are taken.
pub(super) const MAX_VIEWERS: usize = 16;

/// The state of the view that all connections share.
pub(super) struct Shared {
    pub(super) feed: Arc<Feed>,
    pub(super) admission: Admission,
    /// Token with which clients of other computers may stop.
    pub(super) token: String,
    /// Random text by which the page distinguishes this view from another one at the same address.
    pub(super) server: String,
    /// Requests a stop for the client at this address.
    pub(super) stop: Box<dyn Fn(SocketAddr) + Send + Sync>,
    /// Numbers of open connections: from this computer, and from others.
    pub(super) open: [AtomicUsize; 2],
    /// Numbers of those connections that are viewers.
    pub(super) viewers: [AtomicUsize; 2],
}

/// A place for one of a limited number of connections; dropping it frees the place.
pub(super) struct Slot(Arc<Shared>, usize);

impl Slot {
    /// A place for a client; `None` if all are taken. Clients on other computers cannot take the
    /// places for this computer.
    pub(super) fn take(shared: &Arc<Shared>, peer: SocketAddr) -> Option<Self> {
        let side = usize::from(!is_of_this_computer(peer));
        let open = shared.open[side].fetch_add(1, Ordering::Relaxed);
        let slot = Self(Arc::clone(shared), side);
        (open < MAX_CONNECTIONS).then_some(slot)
    }

    /// A place among the viewers; `None` if all are taken.
    fn viewer(&self) -> Option<ViewerPlace<'_>> {
        let viewers = &self.0.viewers[self.1];
        let before = viewers.fetch_add(1, Ordering::Relaxed);
        let place = ViewerPlace(viewers);
        (before < MAX_VIEWERS).then_some(place)
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        self.0.open[self.1].fetch_sub(1, Ordering::Relaxed);
    }
}

/// A place for one of a limited number of viewers; dropping it frees the place.
struct ViewerPlace<'a>(&'a AtomicUsize);

impl Drop for ViewerPlace<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

fn is_of_this_computer(peer: SocketAddr) -> bool {
    peer.ip().to_canonical().is_loopback()
}

/// Serves one client: answers one request, or sends the feed until the client goes or the view
/// closes. A viewer for whom there is no place gets no answer, because a browser tries again after
/// a closed connection but not after a refusal.
pub(super) fn serve(slot: &Slot, mut stream: TcpStream, peer: SocketAddr) {
    let shared = &slot.0;
    if stream.set_write_timeout(Some(STUCK_WITHIN)).is_err() || stream.set_nodelay(true).is_err() {
        return;
    }
    let (request, rest) = match Request::read(&mut stream) {
        Ok(read) => read,
        Err(BadRequest::Gone) => return,
        Err(BadRequest::TooLarge) => {
            return page::send(
                &mut stream,
                &Answer::refusal("431 Request Header Fields Too Large"),
            );
        }
        Err(BadRequest::Malformed) => {
            return page::send(&mut stream, &Answer::refusal("400 Bad Request"));
        }
    };
    match shared.admission.check(&request) {
        Ok(()) => {}
        Err(Refusal::Host) => {
            return page::send(&mut stream, &Answer::refusal("421 Misdirected Request"));
        }
        Err(Refusal::Origin) => {
            return page::send(&mut stream, &Answer::refusal("403 Forbidden"));
        }
    }
    let answer = match (request.method.as_str(), request.path.as_str()) {
        ("GET", "/") if request.is_upgrade() => {
            let Some(_place) = slot.viewer() else { return };
            return foxglove::serve(&shared.feed, stream, &request, rest);
        }
        ("GET", "/events") => {
            let Some(_place) = slot.viewer() else { return };
            return page::events(&shared.feed, &shared.server, stream);
        }
        ("GET", path) => page::asset(path).unwrap_or_else(|| Answer::refusal("404 Not Found")),
        ("POST", "/stop") => stop(shared, &request, peer),
        _ => Answer::refusal("405 Method Not Allowed"),
    };
    page::send(&mut stream, &answer);
}

/// Requests a stop if the client may do so: it is on this computer or has the token. The request
/// must come from the view's own page or from a program that is no browser. It must also have a
/// header that no form and no link can send, which keeps other web pages out.
fn stop(shared: &Shared, request: &Request, peer: SocketAddr) -> Answer {
    if !Admission::is_own_page(request) || request.header("x-qube-hil") != Some("stop") {
        return Answer::refusal("403 Forbidden");
    }
    let token = request.header("authorization").and_then(|value| value.strip_prefix("Bearer "));
    if !is_of_this_computer(peer) && !token.is_some_and(|token| is_equal(token, &shared.token)) {
        return Answer::refusal("401 Unauthorized");
    }
    (shared.stop)(peer);
    shared.feed.update_status(|status| status.stop_requested = true);
    Answer::text("200 OK", "stopping: the arm is braked and the state is kept\n")
}

/// Compares two secrets. For a given length, the time does not depend on the place of a difference.
fn is_equal(one: &str, other: &str) -> bool {
    one.len() == other.len()
        && one.bytes().zip(other.bytes()).fold(0, |all, (a, b)| all | (a ^ b)) == 0
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicU32;

    use super::*;

    fn shared(stops: &Arc<AtomicU32>) -> Arc<Shared> {
        let stops = Arc::clone(stops);
        Arc::new(Shared {
            feed: Arc::default(),
            admission: Admission::default(),
            token: "0123456789abcdef".to_owned(),
            server: "fedcba9876543210".to_owned(),
            stop: Box::new(move |_| {
                stops.fetch_add(1, Ordering::Relaxed);
            }),
            open: Default::default(),
            viewers: Default::default(),
        })
    }

    #[test]
    fn another_computer_needs_the_token_to_stop() {
        let stops = Arc::new(AtomicU32::new(0));
        let shared = shared(&stops);
        let asked = |peer: &str, authorization: &str| {
            let text = format!("POST /stop HTTP/1.1\r\nX-Qube-Hil: stop\r\n{authorization}\r\n");
            let (request, _) = Request::parse(text.as_bytes()).unwrap().unwrap();
            stop(&shared, &request, peer.parse().unwrap());
            stops.load(Ordering::Relaxed)
        };
        let elsewhere = "192.168.1.9:50000";
        assert_eq!(asked(elsewhere, ""), 0);
        assert_eq!(asked(elsewhere, "Authorization: Bearer 0123456789abcdeg\r\n"), 0);
        assert_eq!(asked(elsewhere, "Authorization: Bearer 0123456789abcde\r\n"), 0);
        assert_eq!(asked(elsewhere, "Authorization: 0123456789abcdef\r\n"), 0);
        assert_eq!(asked(elsewhere, "Authorization: Bearer 0123456789abcdef\r\n"), 1);
        assert_eq!(asked("127.0.0.1:50000", ""), 2);
        assert_eq!(asked("[::1]:50000", ""), 3);
        assert_eq!(asked("[::ffff:127.0.0.1]:50000", ""), 4);
        assert_eq!(asked("[::ffff:192.168.1.9]:50000", ""), 4);
    }

    #[test]
    fn other_computers_cannot_take_the_places_of_this_one() {
        let shared = shared(&Arc::default());
        let (here, there) = ("127.0.0.1:1".parse().unwrap(), "192.168.1.9:1".parse().unwrap());
        let taken: Vec<_> = (0..MAX_CONNECTIONS).map(|_| Slot::take(&shared, there)).collect();
        assert!(taken.iter().all(Option::is_some));
        assert!(Slot::take(&shared, there).is_none());
        assert!(Slot::take(&shared, here).is_some());
        drop(taken);
        assert!(Slot::take(&shared, there).is_some());
    }
}
