use std::fs::File;
use std::io::{self, Read};
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::{self, Builder, JoinHandle};
use std::time::{Duration, Instant};

use super::connection::Shared;
use super::feed::{Feed, FeedSender};
use super::origin::Admission;
use super::server::{LiveError, accept, lower_priority};
use super::status::LiveStatus;
use crate::recording::Viewer;

/// Time allowed for connections to end after the view's own threads have ended.
const CLOSING_TIME: Duration = Duration::from_millis(500);

/// The settings of a live view.
#[derive(Clone, Debug)]
pub struct LiveSettings {
    /// Address to listen on; port 0 takes any free port.
    pub address: SocketAddr,
    /// Origins of further web pages that may read the feed, for example `https://app.foxglove.dev`.
    /// The view's own page always may, as may pages that a browser loads from its own computer and,
    /// by WebSocket, programs whose origin has a scheme of its own.
    pub origins: Vec<String>,
}

/// A live view, served until it is dropped.
pub struct LiveView {
    address: SocketAddr,
    shared: Arc<Shared>,
    viewer: Arc<FeedSender>,
    threads: Vec<JoinHandle<()>>,
}

impl LiveView {
    /// Listens on the address and serves the view from threads of its own. `stop` is called with
    /// the address of a client that asks to stop.
    ///
    /// # Errors
    /// The view cannot listen on the address, or the system refuses threads or randomness.
    pub fn serve(
        settings: &LiveSettings,
        stop: impl Fn(SocketAddr) + Send + Sync + 'static,
    ) -> Result<Self, LiveError> {
        let at = |source| LiveError::Address { address: settings.address, source };
        let listener = TcpListener::bind(settings.address).map_err(at)?;
        let address = listener.local_addr().map_err(at)?;
        // If a client goes between `poll` and `accept`, the call of `accept` must not block the
        // thread.
        listener.set_nonblocking(true).map_err(at)?;
        let name = rustix::system::uname().nodename().to_string_lossy().into_owned();
        let feed = Arc::new(Feed::default());
        let shared = Arc::new(Shared {
            feed: Arc::clone(&feed),
            admission: Admission { hostname: name, origins: settings.origins.clone() },
            token: random().map_err(LiveError::System)?,
            server: random().map_err(LiveError::System)?,
            stop: Box::new(stop),
            open: Default::default(),
            viewers: Default::default(),
        });
        let (sender, receiver) = feed.channel();
        let of_clients = Arc::clone(&shared);
        let threads = [
            Builder::new().name("live".to_owned()).spawn(move || {
                lower_priority();
                feed.follow(receiver);
            }),
            Builder::new()
                .name("live listener".to_owned())
                .spawn(move || accept(&listener, &of_clients)),
        ];
        let mut view =
            Self { address, shared, viewer: Arc::new(sender), threads: Vec::with_capacity(2) };
        for thread in threads {
            // On an error the view is dropped, which ends a thread that has started.
            view.threads.push(thread.map_err(LiveError::System)?);
        }
        Ok(view)
    }

    /// The address that the view listens on.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// URL of the page. Unless the view listens on a loopback address, the URL contains the token
    /// that the page's Stop button needs on other computers.
    #[must_use]
    pub fn url(&self) -> String {
        let ip = self.address.ip();
        if ip.to_canonical().is_loopback() {
            return format!("http://{}/", self.address);
        }
        let token = &self.shared.token;
        match ip.is_unspecified() {
            true => format!(
                "http://{}:{}/#{token}",
                self.shared.admission.hostname,
                self.address.port()
            ),
            false => format!("http://{}/#{token}", self.address),
        }
    }

    /// The viewer to which a rig's recorder hands its records.
    #[must_use]
    pub fn viewer(&self) -> Arc<dyn Viewer> {
        Arc::<FeedSender>::clone(&self.viewer)
    }

    /// Changes the status of the command, which the view shows.
    pub fn update_status(&self, change: impl FnOnce(&mut LiveStatus)) {
        self.shared.feed.update_status(change);
    }

    /// Number of ticks that were not shown because the view's own thread was late and its queue was
    /// full.
    #[must_use]
    pub fn lost(&self) -> u64 {
        self.shared.feed.lost.load(Ordering::Relaxed)
    }
}

impl Drop for LiveView {
    fn drop(&mut self) {
        self.update_status(|status| status.ended = true);
        self.shared.feed.closed.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            // If a thread of the view has panicked, nothing else ends with it.
            let _ = thread.join();
        }
        let until = Instant::now() + CLOSING_TIME;
        let is_open = || self.shared.open.iter().any(|open| open.load(Ordering::Relaxed) > 0);
        while is_open() && Instant::now() < until {
            thread::sleep(Duration::from_millis(10));
        }
    }
}

/// Returns 128 random bits as 32 hexadecimal digits.
fn random() -> io::Result<String> {
    let mut bytes = [0; 16];
    File::open("/dev/urandom")?.read_exact(&mut bytes)?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}
