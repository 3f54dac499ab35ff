use std::collections::VecDeque;
use std::ffi::OsStr;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};
use rustix::io::Errno;
use rustix::pty::{OpenptFlags, grantpt, ioctl_tiocgptpeer, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, ioctl_tiocnxcl, tcgetattr, tcsetattr};

use super::{Board, EmulatorSettings, UsbBridge};
use crate::clock::{Clock, MonotonicClock, Nanoseconds, enter_realtime, timespec};

/// Interval at which the server clears the exclusive mode of its port, us.
const HOUSEKEEPING_US: u64 = 100_000;

/// An emulated Qube behind a real pseudo-terminal (pty), served by its own thread at wall-clock
/// speed until it is dropped. Hosts open [`port`](Self::port) like a serial port.
#[derive(Debug)]
pub struct EmulatedQube {
    port: PathBuf,
    link: Arc<Mutex<Link>>,
    stop: Arc<OwnedFd>,
    /// The serving thread; if it ends while the port is gone, its result keeps the port's name
    /// reserved.
    server: Option<JoinHandle<io::Result<Option<ReservedName>>>>,
}

/// The port's second name and its target.
#[derive(Debug)]
struct Link {
    path: Option<PathBuf>,
    port: PathBuf,
}

impl Link {
    fn lock(link: &Mutex<Self>) -> MutexGuard<'_, Self> {
        link.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Removes the second name when the port is gone, unless another process has taken the name.
    fn remove_name(&self) {
        if let Some(path) = &self.path
            && std::fs::read_link(path).is_ok_and(|target| target == self.port)
        {
            let _ = std::fs::remove_file(path);
        }
    }

    /// Points the second name to the port that has come back, possibly under another path.
    fn point_to(&mut self, port: PathBuf) -> io::Result<()> {
        self.port = port;
        match &self.path {
            Some(path) => std::os::unix::fs::symlink(&self.port, path),
            None => Ok(()),
        }
    }
}

/// Returns whether this is the path of a pty that is gone.
fn is_gone_pty(target: &Path) -> bool {
    target.starts_with("/dev/pts") && !target.exists()
}

/// The error message for a port's name that another file or link has.
fn taken(path: &Path) -> String {
    let reason = match std::fs::read_link(path) {
        Ok(target) => {
            format!("is a link to {}, perhaps of another emulated Qube", target.display())
        }
        Err(_) => "exists and is not a link".into(),
    };
    format!("{} {reason}: choose another name, or remove it", path.display())
}

/// The two ends of a pty.
struct Pty {
    master: OwnedFd,
    /// The server's own descriptor of the port. It keeps the pty from hanging up while no host has
    /// the port open. With it the server also clears the exclusive mode that a killed host leaves:
    /// the kernel keeps that mode while the pty lives, and only root could open the port again.
    /// (Hosts exclude each other by file locks, which end with the host.)
    port_side: OwnedFd,
    port: PathBuf,
}

impl Pty {
    fn open() -> io::Result<Self> {
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
        grantpt(&master)?;
        unlockpt(&master)?;
        let flags = OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC;
        let port_side = ioctl_tiocgptpeer(&master, flags)?;
        // Raw mode from the start: a pty echoes until a host sets raw mode, and would send the
        // board its own replies.
        let mut attributes = tcgetattr(&port_side)?;
        attributes.make_raw();
        tcsetattr(&port_side, OptionalActions::Now, &attributes)?;
        rustix::io::ioctl_fionbio(&master, true)?;
        let name = ptsname(&master, Vec::new())?;
        let port = PathBuf::from(OsStr::from_bytes(name.as_bytes()));
        Ok(Self { master, port_side, port })
    }
}

/// Reserves the name of a port that is gone. Otherwise the kernel would give this name to the
/// next pty, and a program that opens its lost port again would find another program's pty.
struct ReservedName {
    _port_side: OwnedFd,
}

impl EmulatedQube {
    /// Opens a pty and starts serving it.
    ///
    /// # Errors
    /// The operating system refuses a pty, a wake-up counter or a thread.
    pub fn spawn(settings: EmulatorSettings) -> io::Result<Self> {
        let pty = Pty::open()?;
        let port = pty.port.clone();
        let link = Arc::new(Mutex::new(Link { path: None, port: port.clone() }));
        let stop = Arc::new(eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?);
        let (stopped, linked) = (Arc::clone(&stop), Arc::clone(&link));
        let server = std::thread::Builder::new().name("emulated-qube".into()).spawn(move || {
            // The thread stands for a microcontroller, which no other program delays. If real-time
            // priority is refused, the thread serves at ordinary priority, and ticks may be late.
            let _ = enter_realtime();
            let mut server = Server::new(&stopped, settings);
            let mut pty = pty;
            loop {
                if server.serve(&pty)? == Served::Stopped {
                    return Ok(None);
                }
                // The kernel hangs the port up when its master is closed.
                let name = ReservedName { _port_side: pty.port_side };
                drop(pty.master);
                Link::lock(&linked).remove_name();
                if server.wait_for_plug()? == Served::Stopped {
                    return Ok(Some(name));
                }
                drop(name);
                pty = Pty::open()?;
                Link::lock(&linked).point_to(pty.port.clone())?;
            }
        })?;
        Ok(Self { port, link, stop, server: Some(server) })
    }

    /// The path of the first port. After the cable was pulled, the port may return under another
    /// path, to which the [second name](Self::link_as) then leads.
    #[must_use]
    pub fn port(&self) -> &Path {
        &self.port
    }

    /// Gives the port a second name, a symbolic link that is removed with the Qube. It replaces a
    /// link to a pty that is gone, which a killed emulator leaves, and nothing else.
    ///
    /// # Errors
    /// Another file or link has the name, or the link cannot be created.
    pub fn link_as(&mut self, path: &Path) -> io::Result<()> {
        let mut link = Link::lock(&self.link);
        // The kernel may have given this port the number of the pty that is gone.
        let is_left = |target: PathBuf| target == link.port || is_gone_pty(&target);
        if std::fs::read_link(path).is_ok_and(is_left) {
            std::fs::remove_file(path)?;
        }
        std::os::unix::fs::symlink(&link.port, path).map_err(|error| match error.kind() {
            io::ErrorKind::AlreadyExists => io::Error::new(error.kind(), taken(path)),
            _ => error,
        })?;
        link.path = Some(path.to_owned());
        Ok(())
    }

    /// Returns whether the Qube has ended by itself: a fault took its port away permanently, or its
    /// pty failed.
    #[must_use]
    pub fn is_gone(&self) -> bool {
        self.server.as_ref().is_none_or(JoinHandle::is_finished)
    }
}

impl Drop for EmulatedQube {
    fn drop(&mut self) {
        // The counter cannot be full, because this is its only write.
        let _ = rustix::io::write(&*self.stop, &1_u64.to_ne_bytes());
        if let Some(server) = self.server.take() {
            let _ = server.join();
        }
        Link::lock(&self.link).remove_name();
    }
}

/// Time that request and reply take on the board's serial line, us. It delays the replies behind a
/// bridge; without a bridge the pty delivers them at once.
const ON_THE_LINE_US: u64 = 1_000;

/// Replies that a bridge holds back, each with its time of arrival at the host, us.
#[derive(Debug, Default)]
struct HeldReplies {
    bridge: Option<UsbBridge>,
    replies: VecDeque<(u64, Vec<u8>)>,
}

impl HeldReplies {
    fn take(&mut self, bridge: UsbBridge, now_us: u64, bytes: &[u8]) {
        let arrival_ns = bridge.leaves_bridge_ns(now_us * 1000) + ON_THE_LINE_US * 1000;
        self.replies.push_back((bridge.reaches_host_ns(arrival_ns) / 1000, bytes.to_vec()));
    }

    fn next_us(&self) -> Option<u64> {
        self.replies.front().map(|reply| reply.0)
    }

    fn hand_over(&mut self, master: &impl AsFd, now_us: u64) -> io::Result<()> {
        while let Some((_, bytes)) = self.replies.pop_front_if(|reply| reply.0 <= now_us) {
            write(master, &bytes)?;
        }
        Ok(())
    }
}

/// Writes bytes to the host; a host that does not read loses them, as on a real line.
fn write(master: &impl AsFd, bytes: &[u8]) -> io::Result<()> {
    match rustix::io::write(master, bytes) {
        Ok(_) | Err(Errno::AGAIN | Errno::INTR) => Ok(()),
        Err(error) => Err(error.into()),
    }
}

/// The reason why serving a pty ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Served {
    /// The Qube was dropped, or its port is gone permanently.
    Stopped,
    /// The port is gone, or the cable is plugged in again.
    Plug,
}

struct Server<'a> {
    stop: &'a OwnedFd,
    board: Board,
    under_way: HeldReplies,
    start_ns: Nanoseconds,
}

impl<'a> Server<'a> {
    fn new(stop: &'a OwnedFd, settings: EmulatorSettings) -> Self {
        Self {
            stop,
            board: Board::new(settings),
            under_way: HeldReplies { bridge: settings.bridge, ..HeldReplies::default() },
            start_ns: MonotonicClock.now_ns(),
        }
    }

    fn now_us(&self) -> u64 {
        (MonotonicClock.now_ns() - self.start_ns) / 1000
    }

    /// Time from the present until `wake_us` of the board's clock; zero if that has passed.
    fn timeout(&self, wake_us: u64) -> Timespec {
        let wake_ns = self.start_ns.saturating_add(wake_us.saturating_mul(1000));
        timespec(wake_ns.saturating_sub(MonotonicClock.now_ns()))
    }

    fn serve(&mut self, pty: &Pty) -> io::Result<Served> {
        let mut housekeeping_us = 0;
        loop {
            self.board.advance_to(self.now_us());
            self.exchange(&pty.master)?;
            let now_us = self.now_us();
            self.under_way.hand_over(&pty.master, now_us)?;
            if self.board.is_unplugged() {
                return Ok(Served::Plug);
            }
            if now_us >= housekeeping_us {
                ioctl_tiocnxcl(&pty.port_side)?;
                housekeeping_us = now_us + HOUSEKEEPING_US;
            }
            let wake_us = [self.board.next_event_us(), self.under_way.next_us()]
                .into_iter()
                .flatten()
                .fold(housekeeping_us, u64::min);
            let timeout = self.timeout(wake_us);
            let mut ready =
                [PollFd::new(&pty.master, PollFlags::IN), PollFd::new(self.stop, PollFlags::IN)];
            match poll(&mut ready, Some(&timeout)) {
                Ok(_) | Err(Errno::INTR) => {}
                Err(error) => return Err(error.into()),
            }
            if !ready[1].revents().is_empty() {
                return Ok(Served::Stopped);
            }
        }
    }

    /// Reads all bytes and answers them. The board's time is read after the bytes, so that the
    /// board handles no request at a time before the request came, however long this thread was
    /// delayed.
    fn exchange(&mut self, master: &impl AsFd) -> io::Result<()> {
        let mut buffer = [0; 256];
        loop {
            let received = match rustix::io::read(master, &mut buffer) {
                Ok(0) | Err(Errno::AGAIN) => return Ok(()),
                Ok(length) => &buffer[..length],
                Err(Errno::INTR) => continue,
                Err(error) => return Err(error.into()),
            };
            // The plant is advanced first, so that its computing time does not count as the
            // board's.
            self.board.advance_to(self.now_us());
            self.board.plant();
            let now_us = self.now_us();
            self.board.advance_to(now_us);
            for &byte in received {
                let Some(reply) = self.board.receive(byte) else { continue };
                let mut bytes = [0; firmware_protocol::MAX_FRAME_BYTES];
                let bytes = &mut bytes[..reply.as_bytes().len()];
                bytes.copy_from_slice(reply.as_bytes());
                if self.board.garbles_reply() {
                    bytes[1] ^= 0x10;
                }
                match self.under_way.bridge {
                    None => write(master, bytes)?,
                    Some(bridge) => self.under_way.take(bridge, now_us, bytes),
                }
            }
        }
    }

    /// Lets the board run without a port until the cable is plugged in again.
    fn wait_for_plug(&mut self) -> io::Result<Served> {
        loop {
            self.board.advance_to(self.now_us());
            if !self.board.is_unplugged() {
                return Ok(Served::Plug);
            }
            let Some(plugged_in_us) = self.board.plugged_in_us() else {
                return Ok(Served::Stopped);
            };
            let wake_us = self.board.next_event_us().unwrap_or(u64::MAX).min(plugged_in_us);
            let timeout = self.timeout(wake_us);
            match poll(&mut [PollFd::new(self.stop, PollFlags::IN)], Some(&timeout)) {
                Ok(0) | Err(Errno::INTR) => {}
                Ok(_) => return Ok(Served::Stopped),
                Err(error) => return Err(error.into()),
            }
        }
    }
}
