use std::os::fd::OwnedFd;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender};
use rustix::event::{EventfdFlags, PollFd, PollFlags, eventfd, poll};
use rustix::io::Errno;

use super::card::Calling;
use super::library::Library;
use super::panel::{NoSample, Panel};
use super::thread;
use super::{HilAddress, HilError};
use crate::clock::{Clock, Nanoseconds, enter_realtime, timespec};
use crate::device::Identity;
use crate::qube::Measurement;

/// Number of requests, and of replies, that fit into their rings. Requests wait there while a call
/// of the library has not returned.
const RING: usize = 8;

/// Longest wait for the library's thread to finish its earlier work and load the library.
const BEGIN_TIME: Duration = Duration::from_secs(1);

/// Longest wait for the amplifier of each service to go off when the process ends.
const AT_EXIT: Duration = Duration::from_millis(200);

/// A request of the tick.
#[derive(Clone, Copy, Debug)]
pub(super) struct Request {
    pub(super) number: u64,
    /// Time after which the request is dropped, ns: after it the tick does not wait for the sample,
    /// or the act answers a sample that is too old.
    pub(super) expires_ns: Nanoseconds,
    pub(super) kind: RequestKind,
}

/// The kinds of requests of the tick.
#[derive(Clone, Copy, Debug)]
pub(super) enum RequestKind {
    Sample,
    Act { voltage_mv: i16, sampled_at_us: u64 },
}

/// An answer to a request for a sample.
#[derive(Clone, Copy, Debug)]
pub(super) struct Reply {
    pub(super) number: u64,
    pub(super) sample: Result<Measurement, NoSample>,
}

/// An operation on the card between motions, with the channel for its result.
pub(super) enum CardOperation {
    Hello(Sender<Result<Identity, HilError>>),
    Arm(Sender<Result<(), HilError>>),
    Off(Sender<Result<(), HilError>>),
    /// Switches the amplifier off and closes the card. After this operation the thread is free for
    /// another service.
    End(Sender<Result<(), HilError>>),
}

/// The reason why an operation has no result.
#[derive(Debug)]
pub(super) enum Unperformed {
    /// The operation took too long, or the thread has ended.
    NoResult,
    /// The operation failed.
    Failed(HilError),
}

/// The control thread's access to one card, whose calls the library's thread makes.
///
/// The tick's requests and replies are `Copy` and pass through wait-free rings. Each side wakes the
/// other with a counter in the kernel (`eventfd`). The control thread waits for its counter up to a
/// time limit, as for a serial port; the library's thread waits without one.
pub(super) struct CardService {
    requests: rtrb::Producer<Request>,
    replies: rtrb::Consumer<Reply>,
    shared: Arc<Shared>,
    clock: Arc<dyn Clock>,
}

/// The parts of a service that any thread may use.
struct Shared {
    operations: Sender<CardOperation>,
    /// Counter that each request and each operation increments.
    asked: OwnedFd,
    /// Counter that each reply increments.
    answered: OwnedFd,
    calling: Arc<Calling>,
}

impl CardService {
    /// Makes the library's thread load the library and begin this service. No card is opened yet.
    pub(super) fn start(address: HilAddress, clock: Arc<dyn Clock>) -> Result<Self, HilError> {
        let port = address.to_string();
        let failed = |reason: String| HilError::NoThread { port: port.clone(), reason };
        let counter = |flags| eventfd(0, flags | EventfdFlags::CLOEXEC);
        let asked = counter(EventfdFlags::empty()).map_err(|error| failed(error.to_string()))?;
        let answered =
            counter(EventfdFlags::NONBLOCK).map_err(|error| failed(error.to_string()))?;
        let (requests, to_serve) = rtrb::RingBuffer::new(RING);
        let (to_reply, replies) = rtrb::RingBuffer::new(RING);
        let (operations, to_do) = crossbeam_channel::unbounded();
        let calling = Arc::new(Calling::default());
        let shared = Arc::new(Shared { operations, asked, answered, calling });
        // A channel without a buffer: `send` fails if `start` has given up waiting and returned an
        // error, and the thread then serves nobody.
        let (loaded, is_loaded) = crossbeam_channel::bounded(0);
        let (serving, its_clock) = (Arc::clone(&shared), Arc::clone(&clock));
        let work = move || {
            let calling = Arc::clone(&serving.calling);
            let panel = Library::load()
                .map(|library| Panel::new(library, address, calling, Arc::clone(&its_clock)));
            match panel {
                Ok(panel) if loaded.send(Ok(())).is_ok() => {
                    // Without real-time rights calls are late. The control thread requests the same
                    // rights and reports a refusal.
                    let _ = enter_realtime();
                    serve(panel, &serving, &to_do, to_serve, to_reply, &*its_clock);
                }
                Ok(_) => {}
                Err(error) => {
                    let _ = loaded.send(Err(error));
                }
            }
        };
        thread::give(Box::new(work)).map_err(|error| failed(error.to_string()))?;
        match is_loaded.recv_timeout(BEGIN_TIME) {
            Ok(loaded) => loaded?,
            Err(RecvTimeoutError::Timeout) => {
                return Err(earlier_call(&*clock, port, BEGIN_TIME));
            }
            Err(RecvTimeoutError::Disconnected) => {
                return Err(failed("it stopped while it loaded the library".into()));
            }
        }
        switch_off_at_exit(&shared);
        Ok(Self { requests, replies, shared, clock })
    }

    /// Hands over a request of the tick without waiting. Returns `false` if earlier requests fill
    /// the ring or the library's thread cannot be woken.
    pub(super) fn ask(&mut self, request: Request) -> bool {
        self.requests.push(request).is_ok() && wake(&self.shared.asked)
    }

    /// Waits until `deadline_ns` for the reply to this request, and drops older replies; `None` if
    /// the reply does not come.
    pub(super) fn wait(&mut self, number: u64, deadline_ns: Nanoseconds) -> Option<Reply> {
        loop {
            while let Ok(reply) = self.replies.pop() {
                if reply.number == number {
                    return Some(reply);
                }
            }
            let left_ns = deadline_ns.saturating_sub(self.clock.now_ns());
            if left_ns == 0 {
                return None;
            }
            let mut ready = [PollFd::new(&self.shared.answered, PollFlags::IN)];
            match poll(&mut ready, Some(&timespec(left_ns))) {
                Ok(_) | Err(Errno::INTR) => {}
                Err(_) => return None,
            }
            let mut count = [0; 8];
            let _ = rustix::io::read(&self.shared.answered, &mut count);
        }
    }

    /// Runs an operation and returns its result.
    ///
    /// # Errors
    /// The operation fails, takes longer than `longest`, or the thread has ended.
    pub(super) fn perform<T>(
        &self,
        operation: impl FnOnce(Sender<Result<T, HilError>>) -> CardOperation,
        longest: Duration,
    ) -> Result<T, Unperformed> {
        self.shared.perform(operation, longest)
    }

    /// The call of the library that has not returned: its name, and the time since it began, s.
    pub(super) fn under_way(&self) -> Option<(&'static str, f64)> {
        self.shared.under_way(&*self.clock)
    }

    /// Requests that the library's thread switch the amplifier off and close the card, and waits
    /// for at most `longest`. Nothing can interrupt a call of the library; if one takes longer, the
    /// card is closed after it.
    pub(super) fn end(&mut self, longest: Duration) {
        let _ = self.shared.perform(CardOperation::End, longest);
    }
}

/// The error of a service that does not begin in time. It names the call of an earlier service in
/// which the library's thread is, if there is one.
fn earlier_call(clock: &dyn Clock, port: String, waited: Duration) -> HilError {
    let alive = ALIVE.lock().unwrap_or_else(PoisonError::into_inner);
    let under_way = alive
        .iter()
        .filter_map(Weak::upgrade)
        .find_map(|service| service.under_way(clock))
        .unwrap_or(("a call", waited.as_secs_f64()));
    let (function, waited_s) = under_way;
    HilError::Hung { port, function, waited_s }
}

impl Shared {
    fn under_way(&self, clock: &dyn Clock) -> Option<(&'static str, f64)> {
        let (function, since_ns) = self.calling.under_way()?;
        let waited_s = clock.now_ns().saturating_sub(since_ns) as f64 * 1e-9;
        Some((function.0, waited_s))
    }

    fn perform<T>(
        &self,
        operation: impl FnOnce(Sender<Result<T, HilError>>) -> CardOperation,
        longest: Duration,
    ) -> Result<T, Unperformed> {
        // A channel without a buffer: `send` fails if the caller has given up waiting.
        let (result, done) = crossbeam_channel::bounded(0);
        self.operations.send(operation(result)).map_err(|_| Unperformed::NoResult)?;
        wake(&self.asked);
        let result = done.recv_timeout(longest).map_err(|_| Unperformed::NoResult)?;
        result.map_err(Unperformed::Failed)
    }
}

/// Increments a counter, which wakes the thread that waits for it.
fn wake(counter: &OwnedFd) -> bool {
    loop {
        match rustix::io::write(counter, &1_u64.to_ne_bytes()) {
            Err(Errno::INTR) => {}
            written => return written.is_ok(),
        }
    }
}

/// Serves requests and operations until [`CardOperation::End`] has been served, or the counter
/// `asked` cannot be read. At the end it switches the amplifier off, if the card accepts that, and
/// closes the card.
fn serve(
    mut panel: Panel,
    shared: &Shared,
    operations: &Receiver<CardOperation>,
    mut requests: rtrb::Consumer<Request>,
    mut replies: rtrb::Producer<Reply>,
    clock: &dyn Clock,
) {
    loop {
        let mut count = [0; 8];
        if rustix::io::read(&shared.asked, &mut count).is_err_and(|error| error != Errno::INTR) {
            break;
        }
        loop {
            if let Ok(operation) = operations.try_recv() {
                // An operation means that the motion is over, so its requests, above all its
                // voltages, must not be served.
                while requests.pop().is_ok() {}
                match operation {
                    CardOperation::Hello(result) => drop(result.send(panel.hello())),
                    // A late arm must not leave the amplifier on for a caller that has given up.
                    CardOperation::Arm(result) => {
                        if result.send(panel.arm()).is_err() {
                            let _ = panel.off();
                        }
                    }
                    CardOperation::Off(result) => drop(result.send(panel.off())),
                    CardOperation::End(result) => {
                        let off = panel.off();
                        panel.close();
                        let _ = result.send(off);
                        return;
                    }
                }
            } else if let Ok(Request { number, expires_ns, kind }) = requests.pop() {
                if clock.now_ns() > expires_ns {
                    continue;
                }
                match kind {
                    RequestKind::Sample => {
                        let sample = panel.sample();
                        let _ = replies.push(Reply { number, sample });
                        wake(&shared.answered);
                    }
                    RequestKind::Act { voltage_mv, sampled_at_us } => {
                        panel.act(voltage_mv, sampled_at_us);
                    }
                }
            } else {
                break;
            }
        }
    }
    if let Err(error) = panel.off() {
        tracing::error!("the amplifier may still be on: {error}");
    }
    panel.close();
}

/// The services whose amplifiers are switched off when the process ends.
static ALIVE: Mutex<Vec<Weak<Shared>>> = Mutex::new(Vec::new());

/// Registers a service, so that its amplifier goes off even if the process ends without dropping
/// the service, for example after a second Ctrl-C. If the process is killed, only the watchdog
/// switches the amplifier off.
fn switch_off_at_exit(shared: &Arc<Shared>) {
    let mut alive = ALIVE.lock().unwrap_or_else(PoisonError::into_inner);
    if alive.is_empty() {
        // SAFETY: the function is a plain one that does not unwind, and stays loaded with the
        // program.
        unsafe { libc::atexit(at_exit) };
    }
    alive.retain(|service| service.strong_count() > 0);
    alive.push(Arc::downgrade(shared));
}

extern "C" fn at_exit() {
    let Ok(alive) = ALIVE.try_lock() else { return };
    for service in alive.iter().filter_map(Weak::upgrade) {
        let _ = service.perform(CardOperation::Off, AT_EXIT);
    }
}
