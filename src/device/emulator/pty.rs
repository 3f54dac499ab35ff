use std::collections::VecDeque;
use std::ffi::OsStr;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::JoinHandle;

use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};
use rustix::io::Errno;
use rustix::pty::{OpenptFlags, grantpt, ioctl_tiocgptpeer, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, ioctl_tiocnxcl, tcgetattr, tcsetattr};

use super::{Board, EmulatorSettings, UsbBridge};
use crate::clock::{Clock, MonotonicClock, enter_realtime};

/// How often an idle server looks after its port.
const HOUSEKEEPING_US: u64 = 100_000;

/// An emulated Qube behind a real pty, served by a thread of its own at wall-clock speed until it
/// is dropped. Open [`port`](Self::port) as if it were a serial port.
#[derive(Debug)]
pub struct EmulatedQube {
    port: PathBuf,
    link: Option<PathBuf>,
    stop: Arc<OwnedFd>,
    server: Option<JoinHandle<io::Result<()>>>,
}

impl EmulatedQube {
    /// Opens a pty and starts serving it.
    ///
    /// # Errors
    /// The operating system has no more ptys or threads.
    pub fn spawn(settings: EmulatorSettings) -> io::Result<Self> {
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
        grantpt(&master)?;
        unlockpt(&master)?;
        let flags = OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC;
        let port_side = ioctl_tiocgptpeer(&master, flags)?;
        // Raw from the start: until the host sets it so itself, an echo would send the board its
        // own replies.
        let mut attributes = tcgetattr(&port_side)?;
        attributes.make_raw();
        tcsetattr(&port_side, OptionalActions::Now, &attributes)?;
        rustix::io::ioctl_fionbio(&master, true)?;
        let name = ptsname(&master, Vec::new())?;
        let port = PathBuf::from(OsStr::from_bytes(name.as_bytes()));

        let stop = Arc::new(eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?);
        let stopped = Arc::clone(&stop);
        let server = std::thread::Builder::new().name("emulated-qube".into()).spawn(move || {
            // It stands for a microcontroller, which nothing keeps from its work. Where this is
            // refused it serves at ordinary priority, and late ticks show it.
            let _ = enter_realtime();
            serve(&master, &port_side, &stopped, settings)
        })?;
        Ok(Self { port, link: None, stop, server: Some(server) })
    }

    /// The port's path.
    #[must_use]
    pub fn port(&self) -> &Path {
        &self.port
    }

    /// Gives the port a second name, a symbolic link that goes when the Qube goes. An old symbolic
    /// link is replaced, anything else is left alone.
    ///
    /// # Errors
    /// There is a file of that name, or none may be made there.
    pub fn link_as(&mut self, link: &Path) -> io::Result<()> {
        match std::fs::symlink_metadata(link) {
            Ok(metadata) if metadata.file_type().is_symlink() => std::fs::remove_file(link)?,
            Ok(_) => {
                return Err(io::Error::new(
                    io::ErrorKind::AlreadyExists,
                    format!("{} exists and is no symbolic link; choose another", link.display()),
                ));
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => return Err(error),
        }
        std::os::unix::fs::symlink(&self.port, link)?;
        self.link = Some(link.to_owned());
        Ok(())
    }

    /// Whether the Qube is gone of itself: unplugged by a fault, or its pty failed.
    #[must_use]
    pub fn is_gone(&self) -> bool {
        self.server.as_ref().is_none_or(JoinHandle::is_finished)
    }
}

impl Drop for EmulatedQube {
    fn drop(&mut self) {
        // The counter cannot be full: this is its only write.
        let _ = rustix::io::write(&*self.stop, &1_u64.to_ne_bytes());
        if let Some(server) = self.server.take() {
            let _ = server.join();
        }
        if let Some(link) = &self.link
            && std::fs::read_link(link).is_ok_and(|target| target == self.port)
        {
            let _ = std::fs::remove_file(link);
        }
    }
}

/// A request and its reply on the board's serial line, us: what a pty leaves out and a bridge waits for.
const ON_THE_LINE_US: u64 = 1_000;

/// Replies that a bridge holds back, each with the time at which the host gets it.
#[derive(Debug, Default)]
struct UnderWay {
    bridge: Option<UsbBridge>,
    replies: VecDeque<(u64, Vec<u8>)>,
}

impl UnderWay {
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

/// Hands bytes to the host; one that does not read loses them, as on a real line.
fn write(master: &impl AsFd, bytes: &[u8]) -> io::Result<()> {
    match rustix::io::write(master, bytes) {
        Ok(_) | Err(Errno::AGAIN | Errno::INTR) => Ok(()),
        Err(error) => Err(error.into()),
    }
}

/// `port_side` is the server's own opening of the port. It keeps the pty from hanging up while no
/// host has it open, and it can take back the exclusive mode that a killed host leaves behind:
/// while the pty lives the kernel does not, and nobody but root could open the port again. (Hosts
/// still exclude each other by their file locks, which end with them.)
fn serve(
    master: &OwnedFd,
    port_side: &OwnedFd,
    stop: &OwnedFd,
    settings: EmulatorSettings,
) -> io::Result<()> {
    let clock = MonotonicClock;
    let start_ns = clock.now_ns();
    let mut board = Board::new(settings);
    let mut under_way = UnderWay { bridge: settings.bridge, ..UnderWay::default() };
    let mut housekeeping_us = 0;
    loop {
        let now_us = (clock.now_ns() - start_ns) / 1000;
        board.advance_to(now_us);
        exchange(master, &mut board, &mut under_way, now_us)?;
        under_way.hand_over(master, now_us)?;
        if board.is_unplugged() {
            return Ok(());
        }
        if now_us >= housekeeping_us {
            ioctl_tiocnxcl(port_side)?;
            housekeeping_us = now_us + HOUSEKEEPING_US;
        }
        let wake_us = [board.next_event_us(), under_way.next_us()]
            .into_iter()
            .flatten()
            .fold(housekeeping_us, u64::min);
        let wait_ns = (start_ns + wake_us * 1000).saturating_sub(clock.now_ns());
        let timeout = Timespec {
            tv_sec: (wait_ns / 1_000_000_000) as i64,
            tv_nsec: (wait_ns % 1_000_000_000) as _,
        };
        let mut ready = [PollFd::new(master, PollFlags::IN), PollFd::new(stop, PollFlags::IN)];
        match poll(&mut ready, Some(&timeout)) {
            Ok(_) | Err(Errno::INTR) => {}
            Err(error) => return Err(error.into()),
        }
        if !ready[1].revents().is_empty() {
            return Ok(());
        }
    }
}

/// Reads until nothing is left and answers.
fn exchange(
    master: &impl AsFd,
    board: &mut Board,
    under_way: &mut UnderWay,
    now_us: u64,
) -> io::Result<()> {
    let mut buffer = [0; 256];
    loop {
        let received = match rustix::io::read(master, &mut buffer) {
            Ok(0) | Err(Errno::AGAIN) => return Ok(()),
            Ok(length) => &buffer[..length],
            Err(Errno::INTR) => continue,
            Err(error) => return Err(error.into()),
        };
        for &byte in received {
            let Some(reply) = board.receive(byte) else { continue };
            let mut bytes = [0; firmware_protocol::MAX_FRAME_BYTES];
            let bytes = &mut bytes[..reply.as_bytes().len()];
            bytes.copy_from_slice(reply.as_bytes());
            if board.garbles_reply() {
                bytes[1] ^= 0x10;
            }
            match under_way.bridge {
                None => write(master, bytes)?,
                Some(bridge) => under_way.take(bridge, now_us, bytes),
            }
        }
    }
}
