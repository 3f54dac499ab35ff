use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

/// Describes the process that has a port open, for messages: `process 1234 (name)`, `process 1234`
/// where the name cannot be read, or `another program` where the process cannot be found.
pub(super) fn holder_of(port: &str) -> String {
    let port = Path::new(port);
    let pid = find_locker(port).or_else(|| find_opener(port));
    pid.map_or_else(|| "another program".to_owned(), described)
}

/// Describes the process that has locked a port, as `process 1234 (name)`, or `process 1234` where
/// the name cannot be read; `None` if the port is not locked or the process cannot be found. The
/// port is not opened. A process that has the port open without a lock does not count, because the
/// emulated Qube has its own port open.
#[must_use]
pub fn locker_of(port: &str) -> Option<String> {
    find_locker(Path::new(port)).map(described)
}

/// A process in words: its id, and its name where that can be read.
fn described(pid: u32) -> String {
    match fs::read_to_string(format!("/proc/{pid}/comm")) {
        Ok(command) => format!("process {pid} ({})", command.trim()),
        Err(_) => format!("process {pid}"),
    }
}

/// The id of the process that holds a lock on the port's file. Every user may read the list of
/// locks.
fn find_locker(port: &Path) -> Option<u32> {
    let port = fs::metadata(port).ok()?;
    let (major, minor) = (rustix::fs::major(port.dev()), rustix::fs::minor(port.dev()));
    let file = format!("{major:02x}:{minor:02x}:{}", port.ino());
    let locks = fs::read_to_string("/proc/locks").ok()?;
    locks.lines().find_map(|lock| locker(lock, &file))
}

/// The id of the process in a line of `/proc/locks`; `None` unless the line is a `flock` lock of
/// `file`, given as `major:minor:inode`. Example: `1: FLOCK ADVISORY WRITE 708 00:14:3 0 EOF`.
fn locker(lock: &str, file: &str) -> Option<u32> {
    let mut words = lock.split_whitespace().skip(1);
    (words.next()? == "FLOCK").then_some(())?;
    let pid = words.nth(2)?.parse().ok()?;
    (words.next()? == file).then_some(pid)
}

/// The id of a process that has the port open; only root sees the open files of other users'
/// processes.
fn find_opener(port: &Path) -> Option<u32> {
    let port = fs::canonicalize(port).ok()?;
    fs::read_dir("/proc").ok()?.flatten().find_map(|process| {
        let pid = process.file_name().to_str()?.parse().ok()?;
        fs::read_dir(process.path().join("fd"))
            .ok()?
            .flatten()
            .any(|descriptor| fs::read_link(descriptor.path()).is_ok_and(|target| target == port))
            .then_some(pid)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_of_the_lock_list_is_read() {
        let line = "3: FLOCK  ADVISORY  WRITE 708 00:14:3 0 EOF";
        assert_eq!(locker(line, "00:14:3"), Some(708));
        assert_eq!(locker(line, "00:14:4"), None);
        assert_eq!(locker("1: POSIX  ADVISORY  READ 9 00:14:3 0 EOF", "00:14:3"), None);
        assert_eq!(locker("", "00:14:3"), None);
    }

    #[test]
    fn the_process_that_has_a_file_open_is_found() {
        let file = tempfile::NamedTempFile::new().unwrap();
        assert_eq!(find_opener(file.path()), Some(std::process::id()));
    }
}
