//! Tests the wire over a real pty and the serial port library, against the emulated Qube.
//!
//! Nothing here depends on the load of the computer: a time limit is by the device's clock or has
//! seconds to spare, or the test tries again.

use std::io::{Read, Write};
use std::os::fd::{AsRawFd, FromRawFd, IntoRawFd, OwnedFd};
use std::os::unix::fs::symlink;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use qube_hil::clock::{Clock, MonotonicClock, Nanoseconds};
use qube_hil::device::emulator::{EmulatedQube, EmulatorFault, EmulatorSettings};
use qube_hil::device::{Device, DeviceError, LinkFault, SerialLink, Tty};
use qube_hil::qube::Measurement;

/// Time within which even a busy computer finishes a step of a test, ns.
const PATIENCE_NS: Nanoseconds = 5_000_000_000;

fn qube(fault: Option<EmulatorFault>) -> EmulatedQube {
    EmulatedQube::spawn(EmulatorSettings { fault, seed: 3, ..EmulatorSettings::default() }).unwrap()
}

fn open(qube: &EmulatedQube) -> SerialLink<Tty> {
    SerialLink::open(qube.port().to_str().unwrap(), Arc::new(MonotonicClock)).unwrap()
}

fn sample(link: &mut SerialLink<Tty>) -> Measurement {
    link.sample(MonotonicClock.now_ns() + PATIENCE_NS).unwrap()
}

/// Greets and arms until a sample shows the device armed and it accepts an act of 0 V: on a busy
/// computer the watchdog may be faster than the test.
fn arm(link: &mut SerialLink<Tty>) {
    let end_ns = MonotonicClock.now_ns() + PATIENCE_NS;
    loop {
        assert!(MonotonicClock.now_ns() < end_ns, "the device is not armed");
        link.hello().unwrap();
        link.arm().unwrap();
        let sample = sample(link);
        if sample.status.armed && link.act(0, sample.device_time_us).is_ok() {
            return;
        }
    }
}

#[test]
fn an_emulated_qube_is_reached_like_a_real_one() {
    let qube = qube(None);
    let mut link = open(&qube);
    let identity = link.hello().unwrap();
    assert_eq!(identity.kind, "emulator");
    assert_eq!(identity.port, qube.port().to_str().unwrap());

    arm(&mut link);
    let start = sample(&mut link);
    let mut moved = start;
    let end_ns = MonotonicClock.now_ns() + PATIENCE_NS;
    while (moved.theta_counts - start.theta_counts).abs() < 20 {
        assert!(MonotonicClock.now_ns() < end_ns, "the arm does not move");
        if link.act(3000, moved.device_time_us).is_err() {
            arm(&mut link);
        }
        moved = sample(&mut link);
    }
    assert!(moved.theta_counts > start.theta_counts);
    assert!(moved.device_time_us > start.device_time_us);
    link.disarm().unwrap();
    assert!(!sample(&mut link).status.armed);
}

#[test]
fn the_watchdog_switches_the_motor_off_and_it_stays_off() {
    // `tests/real_time/preflight_conformance.rs` tests the watchdog's timing.
    let qube = qube(None);
    let mut link = open(&qube);
    arm(&mut link);
    let armed = sample(&mut link);
    let mut tripped = armed;
    while !tripped.status.watchdog_tripped {
        assert!(tripped.device_time_us < armed.device_time_us + 55_000);
        tripped = sample(&mut link);
    }
    assert_eq!(tripped.applied_mv, 0);
    assert!(!tripped.status.armed);
    assert_eq!(link.act(1000, tripped.device_time_us), Err(LinkFault::WatchdogTripped));
    assert!(matches!(link.arm(), Err(DeviceError::Refused { .. })));
    assert!(sample(&mut link).status.watchdog_tripped);
    arm(&mut link);
}

#[test]
fn the_host_may_close_and_open_the_port_again() {
    let qube = qube(None);
    for _ in 0..5 {
        let mut link = open(&qube);
        link.hello().unwrap();
    }
    // A host that dies with half a frame on the line does no harm to the next.
    let mut port = serialport::new(qube.port().to_str().unwrap(), 500_000).open().unwrap();
    port.write_all(&[5, 1, 2]).unwrap();
    drop(port);
    open(&qube).hello().unwrap();
}

/// A killed host leaves the port in exclusive mode; only root could open it again if the emulator
/// did not end that mode. (Tests often run as root, so the test reads the mode itself.)
#[test]
fn a_killed_host_does_not_lock_the_port() {
    let qube = qube(None);
    let port = serialport::new(qube.port().to_str().unwrap(), 500_000).open_native().unwrap();
    // SAFETY: `into_raw_fd` gave up the descriptor, so this is its only owner.
    let killed = unsafe { OwnedFd::from_raw_fd(port.into_raw_fd()) };
    drop(killed);
    let look = std::fs::File::options().read(true).write(true).open(qube.port());
    let is_exclusive = |port: &std::fs::File| {
        let mut exclusive: libc::c_int = 0;
        // SAFETY: the descriptor is open and the kernel writes one int.
        let asked = unsafe { libc::ioctl(port.as_raw_fd(), libc::TIOCGEXCL, &mut exclusive) };
        assert_eq!(asked, 0);
        exclusive != 0
    };
    let end_ns = MonotonicClock.now_ns() + PATIENCE_NS;
    while look.as_ref().is_ok_and(is_exclusive)
        || SerialLink::open(qube.port().to_str().unwrap(), Arc::new(MonotonicClock)).is_err()
    {
        assert!(MonotonicClock.now_ns() < end_ns, "the port stays locked");
        std::thread::sleep(Duration::from_millis(10));
    }
}

#[test]
fn another_version_is_named() {
    let qube = qube(Some(EmulatorFault::WrongVersion));
    match open(&qube).hello() {
        Err(DeviceError::VersionMismatch { theirs: 1, ours: 2, .. }) => {}
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_port_without_a_qube_is_named() {
    let (mut master, slave) = serialport::TTYPort::pair().unwrap();
    let port = serialport::SerialPort::name(&slave).unwrap();
    drop(slave);
    let mut silent = SerialLink::open(&port, Arc::new(MonotonicClock)).unwrap();
    let error = silent.hello().unwrap_err().to_string();
    assert!(error.contains(&port) && error.contains("no answer"), "{error}");
    drop(silent);

    let mut chatting = SerialLink::open(&port, Arc::new(MonotonicClock)).unwrap();
    master.write_all(b"login: \0 password: \0").unwrap();
    let error = chatting.hello().unwrap_err().to_string();
    assert!(error.contains("bytes that are not an answer"), "{error}");
    drop(chatting);

    let mut echoing = SerialLink::open(&port, Arc::new(MonotonicClock)).unwrap();
    let echo = std::thread::spawn(move || {
        let mut buffer = [0; 64];
        serialport::SerialPort::set_timeout(&mut master, Duration::from_secs(60)).unwrap();
        // Ends when the last host has closed the port.
        while let Ok(length) = master.read(&mut buffer) {
            master.write_all(&buffer[..length]).unwrap();
        }
    });
    let error = echoing.hello().unwrap_err().to_string();
    assert!(error.contains("it echoes"), "{error}");
    drop(echoing);
    echo.join().unwrap();
}

#[test]
fn a_port_in_use_is_named_with_its_holder() {
    let qube = qube(None);
    let first = open(&qube);
    let second = SerialLink::open(qube.port().to_str().unwrap(), Arc::new(MonotonicClock));
    match second.err() {
        Some(DeviceError::Busy { holder, .. }) => {
            assert!(holder.contains(&format!("process {} (", std::process::id())), "{holder}");
        }
        other => panic!("{other:?}"),
    }
    drop(first);
    open(&qube).hello().unwrap();
}

#[test]
fn a_missing_port_and_a_file_are_named() {
    let open = |port: &str| SerialLink::open(port, Arc::new(MonotonicClock)).err();
    assert!(matches!(open("/dev/no-such-port"), Some(DeviceError::NoSuchPort { .. })));
    let file = tempfile::NamedTempFile::new().unwrap();
    for port in ["/dev/null", "/tmp", file.path().to_str().unwrap()] {
        match open(port) {
            Some(DeviceError::NotAQube { reason, .. }) => {
                assert!(reason.contains("not a serial port"), "{port}: {reason}");
            }
            other => panic!("{port}: {other:?}"),
        }
    }
}

#[test]
fn an_unplugged_qube_is_gone() {
    let qube = qube(None);
    let mut link = open(&qube);
    link.hello().unwrap();
    drop(qube);
    assert_eq!(link.sample(MonotonicClock.now_ns() + PATIENCE_NS), Err(LinkFault::Gone));
    assert!(matches!(link.hello(), Err(DeviceError::Link { fault: LinkFault::Gone, .. })));
}

#[test]
fn the_name_of_a_port_whose_cable_is_out_is_given_to_no_other() {
    let gone = qube(Some(EmulatorFault::Unplugged { after_s: 0.0 }));
    let end_ns = MonotonicClock.now_ns() + PATIENCE_NS;
    while !gone.is_gone() {
        assert!(MonotonicClock.now_ns() < end_ns, "the port stays");
        std::thread::sleep(Duration::from_millis(1));
    }
    assert!(!gone.port().exists());
    let others = [(); 3].map(|()| qube(None));
    assert!(others.iter().all(|other| other.port() != gone.port()), "{others:?}");
}

#[test]
fn a_second_name_goes_with_the_qube() {
    let folder = tempfile::tempdir().unwrap();
    let name = folder.path().join("qube");
    let mut qube = qube(None);
    qube.link_as(&name).unwrap();
    let mut link = SerialLink::open(name.to_str().unwrap(), Arc::new(MonotonicClock)).unwrap();
    link.hello().unwrap();
    drop(link);
    drop(qube);
    assert!(name.symlink_metadata().is_err());
}

#[test]
fn a_second_name_that_anything_else_has_is_refused_and_stays() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let mut first = qube(None);
    first.link_as(&at("qube")).unwrap();
    std::fs::write(at("file"), "mine").unwrap();
    symlink(at("file"), at("link")).unwrap();
    symlink(at("nothing"), at("dangling")).unwrap();
    // A killed emulator leaves a link to a pty that is gone.
    let gone = Path::new("/dev/pts/4000000000");
    symlink(gone, at("left")).unwrap();

    let mut second = qube(None);
    for name in ["qube", "file", "link", "dangling"] {
        let error = second.link_as(&at(name)).unwrap_err().to_string();
        assert!(error.contains(name) && error.contains("choose another name"), "{error}");
    }
    // The next pty may have the number of the closed one.
    symlink(second.port(), at("of-its-number")).unwrap();
    for name in ["of-its-number", "left"] {
        second.link_as(&at(name)).unwrap();
        assert_eq!(std::fs::read_link(at(name)).unwrap(), second.port());
    }
    drop(second);
    assert!(at("left").symlink_metadata().is_err());
    assert_eq!(std::fs::read_link(at("qube")).unwrap(), first.port());
    assert_eq!(std::fs::read_to_string(at("link")).unwrap(), "mine");
    assert!(at("dangling").is_symlink());
    drop(first);
    assert!(at("qube").symlink_metadata().is_err());
}

#[test]
fn a_port_is_opened_again_and_shows_whether_the_board_has_restarted() {
    // The port has a name of its own, because the kernel gives the number of a closed pty to the
    // next one, which may be another test's.
    let folder = tempfile::tempdir().unwrap();
    let name = folder.path().join("qube");
    let mut quiet = qube(None);
    quiet.link_as(&name).unwrap();
    let mut link = SerialLink::open(name.to_str().unwrap(), Arc::new(MonotonicClock)).unwrap();
    let first = link.hello().unwrap();
    arm(&mut link);
    link.reopen().unwrap();
    let same = link.hello().unwrap();
    assert!(first.is_same_start(&same), "{first:?} {same:?}");
    arm(&mut link);

    // Without the Qube, reopening reports that the port is gone, and so does a sample.
    drop(quiet);
    assert!(matches!(link.reopen(), Err(DeviceError::NoSuchPort { .. } | DeviceError::Io { .. })));
    assert_eq!(link.sample(MonotonicClock.now_ns() + PATIENCE_NS), Err(LinkFault::Gone));

    // On a busy computer even the first hello may follow the restart; both hellos then show the
    // same start.
    let saw_the_restart = (0..20).any(|_| {
        let restarting = qube(Some(EmulatorFault::BrownOut { after_s: 1.0 }));
        let mut link = open(&restarting);
        let before = link.hello().unwrap();
        std::thread::sleep(Duration::from_millis(1100));
        link.reopen().unwrap();
        let after = link.hello().unwrap();
        assert!(before.is_same_board(&after), "{before:?} {after:?}");
        !before.is_same_start(&after)
    });
    assert!(saw_the_restart);
}
