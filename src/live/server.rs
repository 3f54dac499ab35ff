use std::io;
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::{self, Builder};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::setpriority_process;
use thiserror::Error;

use super::connection::{Shared, Slot, serve};

/// Pause after each connection, which bounds the work that a flood of connections causes.
const PAUSE: Duration = Duration::from_millis(5);

/// Longest time between two checks of whether the view closes.
const POLL_INTERVAL: Timespec = Timespec { tv_sec: 0, tv_nsec: 100_000_000 };

/// Size of the stack of a client's thread, bytes. It is small because the program may have locked
/// its memory for the control thread: each new stack is then filled at once, on a processor that
/// the tick may need.
const STACK_BYTES: usize = 256 * 1024;

/// Niceness of the view's threads: the threads that drive the Qube come first.
const NICENESS: i32 = 10;

/// The reason why the live view cannot be served.
#[derive(Debug, Error)]
pub enum LiveError {
    /// The view cannot listen on the address.
    #[error("{address}: {source}")]
    Address {
        /// Address that the view was to listen on.
        address: SocketAddr,
        /// Error of the system.
        source: io::Error,
    },
    /// A thread cannot be started, or there is no randomness for a token.
    #[error("the live view cannot be started: {0}")]
    System(#[source] io::Error),
}

/// Lowers the priority of the calling thread and of the threads that it starts.
pub(super) fn lower_priority() {
    // On Linux the call changes the calling thread alone. If the system refuses the call, the view
    // works with the normal priority.
    let _ = setpriority_process(None, NICENESS);
}

/// Accepts connections until the view closes; each connection has a thread of its own.
pub(super) fn accept(listener: &TcpListener, shared: &Arc<Shared>) {
    lower_priority();
    while !shared.feed.closed.load(Ordering::Relaxed) {
        let mut waiting = [PollFd::new(listener, PollFlags::IN)];
        if !matches!(poll(&mut waiting, Some(&POLL_INTERVAL)), Ok(1..)) {
            continue;
        }
        if let Ok((stream, peer)) = listener.accept()
            && let Some(slot) = Slot::take(shared, peer)
        {
            // If no thread can be started, the connection is closed.
            let _ = Builder::new()
                .name("live client".to_owned())
                .stack_size(STACK_BYTES)
                .spawn(move || serve(&slot, stream, peer));
        }
        thread::sleep(PAUSE);
    }
}
