//! A disk in memory that fails at chosen operations and can lose its power.
//!
//! Until a file is synced, its new bytes may be lost or read as zeros, and a file that was cut or
//! begun anew may have its old bytes again. Bytes that a failed sync has not written are not
//! written by a later sync either, as under Linux. Until a folder is synced, a loss of power leaves
//! either all of its old names or all of its new names.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fmt;
use std::fs::TryLockError;
use std::io::{self, ErrorKind, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use qube_hil::storage::{Disk, DiskFile, Existing, FolderLock};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A failure of an operation that changes the disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DiskFault {
    /// The disk is full, permanently: a write takes half of its bytes and then fails.
    Full,
    /// The file system has become read-only, permanently.
    ReadOnly,
    /// A write or a change of names fails with EIO, once; a write takes half of its bytes.
    WriteFails,
    /// The next sync fails with EIO, once; bytes of a file that it should have written are lost.
    SyncFails,
    /// The process is killed, or the power fails, during the operation. Every later operation that
    /// changes the disk fails, until [`SimulatedDisk::restarted`].
    Crash,
}

/// The way in which a machine stops.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stopped {
    /// The process is gone; the operating system keeps the data that it has received.
    Killed,
    /// The machine is off; the seed decides which unsynced data survive.
    PowerLost(u64),
}

/// The content of a file, as processes read it and as the disk holds it.
#[derive(Clone, Debug, Default)]
struct Node {
    /// Bytes that a process reads.
    bytes: Vec<u8>,
    /// Bytes on disk after the last sync.
    synced: Vec<u8>,
    /// Number of leading bytes of `synced` that have not changed since the last sync.
    kept: usize,
    /// Range of `bytes` that a failed sync has not written; the next sync leaves zeros there.
    lost: Range<usize>,
}

impl Node {
    /// A file with these bytes, on disk.
    fn on_disk(bytes: Vec<u8>) -> Self {
        Self { synced: bytes.clone(), kept: bytes.len(), bytes, lost: 0..0 }
    }

    fn cut_to(&mut self, length: usize) {
        self.bytes.truncate(length);
        self.kept = self.kept.min(length);
        self.lost.end = self.lost.end.min(length);
    }

    fn sync(&mut self) {
        self.synced.truncate(self.kept);
        self.synced.extend_from_slice(&self.bytes[self.kept..]);
        if let Some(lost) = self.synced.get_mut(self.lost.clone()) {
            lost.fill(0);
        }
        self.kept = self.synced.len();
        self.lost = 0..0;
    }

    fn fail_to_sync(&mut self) {
        self.lost = self.kept..self.bytes.len();
    }

    /// The bytes of the file that have reached the disk: all synced bytes, and some of the others,
    /// the last of them perhaps as zeros. A file that was cut or begun anew may have its synced
    /// content.
    fn after_power_loss(&self, random: &mut ChaCha8Rng) -> Vec<u8> {
        let is_cut = self.kept < self.synced.len();
        if (is_cut && random.random()) || (!is_cut && self.kept == self.bytes.len()) {
            return self.synced.clone();
        }
        let length = random.random_range(self.kept..=self.bytes.len());
        let mut bytes = [&self.synced[..self.kept], &self.bytes[self.kept..length]].concat();
        if random.random() {
            let zeros_from = random.random_range(self.kept..=length);
            bytes[zeros_from..].fill(0);
        }
        bytes
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Name {
    File(usize),
    Folder,
}

#[derive(Clone, Debug, Default)]
struct Content {
    nodes: Vec<Node>,
    names: BTreeMap<PathBuf, Name>,
    synced_names: BTreeMap<PathBuf, Name>,
    operations: u64,
    faults: BTreeMap<u64, DiskFault>,
    lasting: Option<ErrorKind>,
    sync_fails: bool,
}

/// The simulated disk. Clones are handles of the same disk.
#[derive(Clone)]
pub struct SimulatedDisk {
    content: Arc<Mutex<Content>>,
    crashed: Arc<AtomicBool>,
}

impl fmt::Debug for SimulatedDisk {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "SimulatedDisk after {} operations", self.operations())
    }
}

impl Default for SimulatedDisk {
    fn default() -> Self {
        let mut content = Content::default();
        content.names.insert(PathBuf::from("/"), Name::Folder);
        content.synced_names = content.names.clone();
        Self::holding(content)
    }
}

impl SimulatedDisk {
    fn holding(content: Content) -> Self {
        Self { content: Arc::new(Mutex::new(content)), crashed: Arc::default() }
    }

    fn content(&self) -> MutexGuard<'_, Content> {
        self.content.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Number of operations so far that changed the disk.
    pub fn operations(&self) -> u64 {
        self.content().operations
    }

    /// A copy of the disk, all of it synced, without faults.
    pub fn copied(&self) -> Self {
        self.restarted(Stopped::Killed)
    }

    /// Plans faults at operations, counted from now on.
    pub fn plan(&self, faults: impl IntoIterator<Item = (u64, DiskFault)>) {
        let mut content = self.content();
        let now = content.operations;
        content.faults = faults.into_iter().map(|(after, fault)| (now + after, fault)).collect();
    }

    /// A flag that is set once a crash has struck; the whole process is over at that moment.
    pub fn crashed(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.crashed)
    }

    /// The disk after a restart of the process or the machine, without faults.
    pub fn restarted(&self, stopped: Stopped) -> Self {
        let before = self.content().clone();
        let mut after = Content { nodes: before.nodes.clone(), ..Content::default() };
        match stopped {
            Stopped::Killed => after.names = before.names,
            Stopped::PowerLost(seed) => {
                let mut random = ChaCha8Rng::seed_from_u64(seed);
                for node in &mut after.nodes {
                    node.bytes = node.after_power_loss(&mut random);
                }
                // Each folder has its old or its new names.
                let mut is_new: BTreeMap<PathBuf, bool> = BTreeMap::new();
                let mut pick = |path: &Path| {
                    let folder = path.parent().unwrap_or(path).to_owned();
                    *is_new.entry(folder).or_insert_with(|| random.random())
                };
                for (path, name) in &before.synced_names {
                    if !pick(path) {
                        after.names.insert(path.clone(), *name);
                    }
                }
                for (path, name) in &before.names {
                    if pick(path) {
                        after.names.insert(path.clone(), *name);
                    }
                }
                after.names.insert(PathBuf::from("/"), Name::Folder);
                // Files in a missing folder are missing.
                let known = after.names.clone();
                after.names.retain(|path, _| {
                    path.ancestors().skip(1).all(|folder| known.contains_key(folder))
                });
            }
        }
        for node in &mut after.nodes {
            *node = Node::on_disk(std::mem::take(&mut node.bytes));
        }
        after.synced_names = after.names.clone();
        Self::holding(after)
    }

    /// The bytes of a file; `None` if there is no such file.
    pub fn bytes(&self, path: &Path) -> Option<Vec<u8>> {
        let content = self.content();
        match content.names.get(path)? {
            Name::File(node) => Some(content.nodes[*node].bytes.clone()),
            Name::Folder => None,
        }
    }

    /// Gives a file other bytes, on disk at once.
    pub fn put(&self, path: &Path, bytes: &[u8]) {
        let mut content = self.content();
        content.nodes.push(Node::on_disk(bytes.to_vec()));
        let name = Name::File(content.nodes.len() - 1);
        content.names.insert(path.to_owned(), name);
        content.synced_names.insert(path.to_owned(), name);
    }

    /// The paths of all files.
    pub fn files(&self) -> Vec<PathBuf> {
        let content = self.content();
        let files = content.names.iter().filter(|(_, name)| matches!(name, Name::File(_)));
        files.map(|(path, _)| path.clone()).collect()
    }

    /// Counts an operation, and returns an error if a planned fault makes it fail, its own or an
    /// earlier one. Beside the error it returns whether a write takes half of its bytes. A crash
    /// has an error of its own, which every later call returns.
    fn begin(&self, is_sync: bool) -> Result<MutexGuard<'_, Content>, (io::Error, bool)> {
        let mut content = self.content();
        if self.crashed.load(Ordering::SeqCst) {
            return Err((io::Error::other("the machine is off"), false));
        }
        let operation = content.operations;
        content.operations += 1;
        let mut failing = None;
        match content.faults.get(&operation) {
            Some(DiskFault::Full) => content.lasting = Some(ErrorKind::StorageFull),
            Some(DiskFault::ReadOnly) => content.lasting = Some(ErrorKind::ReadOnlyFilesystem),
            Some(DiskFault::WriteFails) if !is_sync => failing = Some(ErrorKind::Other),
            Some(DiskFault::SyncFails) => content.sync_fails = true,
            Some(DiskFault::Crash) => {
                self.crashed.store(true, Ordering::SeqCst);
                return Err((io::Error::other("the machine is off"), true));
            }
            Some(DiskFault::WriteFails) | None => {}
        }
        if is_sync && std::mem::take(&mut content.sync_fails) {
            failing = Some(ErrorKind::Other);
        }
        if !is_sync {
            failing = failing.or(content.lasting);
        }
        match failing {
            Some(ErrorKind::Other) => Err((io::Error::from_raw_os_error(libc::EIO), true)),
            Some(kind) => Err((kind.into(), kind == ErrorKind::StorageFull)),
            None => Ok(content),
        }
    }

    fn change(&self) -> io::Result<MutexGuard<'_, Content>> {
        self.begin(false).map_err(|(error, _)| error)
    }
}

impl Disk for SimulatedDisk {
    fn create_folder(&self, path: &Path) -> io::Result<()> {
        for folder in path.ancestors().collect::<Vec<_>>().into_iter().rev() {
            if self.exists(folder) {
                continue;
            }
            self.change()?.names.insert(folder.to_owned(), Name::Folder);
            self.sync_folder(folder.parent().unwrap_or(folder))?;
        }
        Ok(())
    }

    fn create(&self, path: &Path, existing: Existing) -> io::Result<Box<dyn DiskFile>> {
        let mut content = self.change()?;
        let node = match content.names.get(path) {
            Some(_) if existing == Existing::Refuse => return Err(ErrorKind::AlreadyExists.into()),
            Some(Name::File(node)) => {
                let node = *node;
                content.nodes[node].cut_to(0);
                node
            }
            Some(Name::Folder) => return Err(ErrorKind::IsADirectory.into()),
            None => {
                let parent = path.parent().unwrap_or(path);
                if content.names.get(parent) != Some(&Name::Folder) {
                    return Err(ErrorKind::NotFound.into());
                }
                content.nodes.push(Node::default());
                let node = content.nodes.len() - 1;
                content.names.insert(path.to_owned(), Name::File(node));
                node
            }
        };
        drop(content);
        Ok(Box::new(SimulatedFile { disk: self.clone(), node }))
    }

    fn append(&self, path: &Path) -> io::Result<Box<dyn DiskFile>> {
        if let Some(Name::File(node)) = self.content().names.get(path) {
            return Ok(Box::new(SimulatedFile { disk: self.clone(), node: *node }));
        }
        self.create(path, Existing::Refuse)
    }

    fn read_beginning(&self, path: &Path, limit: u64) -> io::Result<Vec<u8>> {
        let mut bytes = self.bytes(path).ok_or(ErrorKind::NotFound)?;
        bytes.truncate(limit as usize);
        Ok(bytes)
    }

    fn exists(&self, path: &Path) -> bool {
        self.content().names.contains_key(path)
    }

    fn names(&self, folder: &Path) -> io::Result<Vec<OsString>> {
        let content = self.content();
        match content.names.get(folder) {
            Some(Name::Folder) => {}
            Some(Name::File(_)) => return Err(ErrorKind::NotADirectory.into()),
            None => return Err(ErrorKind::NotFound.into()),
        }
        let inside = content.names.keys().filter(|path| path.parent() == Some(folder));
        Ok(inside.filter_map(|path| path.file_name().map(OsString::from)).collect())
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        let mut content = self.change()?;
        let name = content.names.remove(from).ok_or(ErrorKind::NotFound)?;
        content.names.insert(to.to_owned(), name);
        Ok(())
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        self.change()?.names.remove(path).map(drop).ok_or(ErrorKind::NotFound.into())
    }

    fn remove_folder(&self, path: &Path) -> io::Result<()> {
        if !self.names(path)?.is_empty() {
            return Err(ErrorKind::DirectoryNotEmpty.into());
        }
        self.remove(path)
    }

    fn sync_folder(&self, path: &Path) -> io::Result<()> {
        let mut content = self.begin(true).map_err(|(error, _)| error)?;
        content.synced_names.retain(|name, _| name.parent() != Some(path));
        let now: Vec<_> = content
            .names
            .iter()
            .filter(|(name, _)| name.parent() == Some(path))
            .map(|(name, node)| (name.clone(), *node))
            .collect();
        content.synced_names.extend(now);
        Ok(())
    }

    fn lock_folder(&self, _folder: &Path) -> Result<FolderLock, TryLockError> {
        Ok(FolderLock::unshared())
    }
}

#[derive(Debug)]
struct SimulatedFile {
    disk: SimulatedDisk,
    node: usize,
}

impl Write for SimulatedFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self.disk.begin(false) {
            Ok(mut content) => {
                content.nodes[self.node].bytes.extend_from_slice(bytes);
                Ok(bytes.len())
            }
            Err((error, takes_half)) => {
                if takes_half {
                    let half = &bytes[..bytes.len() / 2];
                    self.disk.content().nodes[self.node].bytes.extend_from_slice(half);
                }
                Err(error)
            }
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl DiskFile for SimulatedFile {
    fn sync(&mut self) -> io::Result<()> {
        match self.disk.begin(true) {
            Ok(mut content) => {
                content.nodes[self.node].sync();
                Ok(())
            }
            Err((error, _)) => {
                self.disk.content().nodes[self.node].fail_to_sync();
                Err(error)
            }
        }
    }

    fn cut_to(&mut self, length: u64) -> io::Result<()> {
        self.disk.change()?.nodes[self.node].cut_to(length as usize);
        Ok(())
    }
}

/// Tests the simulated disk itself.
#[test]
fn synced_bytes_survive_and_others_may_be_lost() {
    let disk = SimulatedDisk::default();
    let path = Path::new("/a/file");
    disk.create_folder(Path::new("/a")).unwrap();
    let mut file = disk.create(path, Existing::Refuse).unwrap();
    file.write_all(b"kept").unwrap();
    file.sync().unwrap();
    let after = |seed| disk.restarted(Stopped::PowerLost(seed)).bytes(path);
    let found: Vec<_> = (0..64).map(after).collect();
    assert!(found.contains(&None) && found.contains(&Some(b"kept".to_vec())), "{found:?}");
    disk.sync_folder(Path::new("/a")).unwrap();
    file.write_all(b" lost").unwrap();
    let found: Vec<_> = (0..64).map(after).map(Option::unwrap).collect();
    assert!(found.iter().all(|bytes| bytes.starts_with(b"kept")));
    assert!(found.iter().any(|bytes| bytes == b"kept"));
    assert!(found.iter().any(|bytes| bytes.contains(&0)));
    let killed = disk.restarted(Stopped::Killed).bytes(path);
    assert_eq!(killed, Some(b"kept lost".to_vec()));
}

#[test]
fn a_file_that_is_begun_anew_may_be_cut_anywhere() {
    let disk = SimulatedDisk::default();
    let path = Path::new("/file");
    disk.put(path, b"old");
    disk.create(path, Existing::Replace).unwrap().write_all(b"newer").unwrap();
    let after = |seed| disk.restarted(Stopped::PowerLost(seed)).bytes(path).unwrap();
    let found: Vec<_> = (0..256).map(after).collect();
    for wanted in [&b"old"[..], b"", b"new", b"newer"] {
        assert!(found.iter().any(|bytes| bytes == wanted), "{wanted:?} is not in {found:?}");
    }
}

#[test]
fn bytes_of_a_failed_sync_stay_lost() {
    let disk = SimulatedDisk::default();
    let path = Path::new("/file");
    disk.put(path, b"kept");
    let mut file = disk.append(path).unwrap();
    file.write_all(b" lost").unwrap();
    disk.plan([(0, DiskFault::SyncFails)]);
    assert!(file.sync().is_err());
    file.write_all(b" new").unwrap();
    file.sync().unwrap();
    let after = disk.restarted(Stopped::PowerLost(0)).bytes(path).unwrap();
    assert_eq!(after, b"kept\0\0\0\0\0 new");

    // Lost bytes that are cut off and written again reach the disk.
    file.cut_to(4).unwrap();
    file.write_all(b" again").unwrap();
    file.sync().unwrap();
    let after = disk.restarted(Stopped::PowerLost(0)).bytes(path).unwrap();
    assert_eq!(after, b"kept again");
}
