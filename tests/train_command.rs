//! Tests the command `train`: the policy does not depend on the number of threads, the instruction
//! set, or interruptions.

use std::path::Path;
use std::process::{Command, Output};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

fn train(directory: &Path, out: &str, more: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_qube-hil"));
    command
        .current_dir(directory)
        .args(["train", "--preset", "quick", "--seed", "3", "--out", out])
        .args(more);
    command
}

fn succeeds(output: &Output) {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn the_policy_is_the_same_on_two_threads_and_with_the_instructions_of_an_older_processor() {
    let directory = tempfile::tempdir().unwrap();
    let bytes = |out: &str, more: &[&str]| {
        // A bare file name: the file goes into the working directory.
        succeeds(&train(directory.path(), out, more).output().unwrap());
        std::fs::read(directory.path().join(out)).unwrap()
    };
    let expected = bytes("best.safetensors", &[]);
    assert!(expected == bytes("threads.safetensors", &["--threads", "2"]));
    assert!(expected == bytes("avx2.safetensors", &["--instruction-set", "avx2"]));
}

#[test]
fn a_training_that_was_stopped_and_gone_on_with_gives_the_same_policy() {
    let directory = tempfile::tempdir().unwrap();
    let checkpoint = directory.path().join("half.safetensors");
    let resumable = ["--checkpoint", "half.safetensors"];

    succeeds(&train(directory.path(), "whole.safetensors", &[]).output().unwrap());
    let mut stopped = train(directory.path(), "resumed.safetensors", &resumable).spawn().unwrap();
    let patience = Instant::now();
    while !checkpoint.exists() {
        assert!(patience.elapsed() < Duration::from_secs(120), "no checkpoint was written");
        std::thread::sleep(Duration::from_millis(2));
    }
    kill_process(Pid::from_child(&stopped), Signal::TERM).unwrap();
    assert_eq!(stopped.wait().unwrap().code(), Some(143), "it was finished before it was stopped");
    assert!(checkpoint.exists() && !directory.path().join("resumed.safetensors").exists());

    succeeds(&train(directory.path(), "resumed.safetensors", &resumable).output().unwrap());
    assert!(!checkpoint.exists(), "the checkpoint of a finished training stays");
    let read = |name: &str| std::fs::read(directory.path().join(name)).unwrap();
    assert!(read("whole.safetensors") == read("resumed.safetensors"));

    std::fs::write(&checkpoint, b"nonsense").unwrap();
    let refused = train(directory.path(), "no.safetensors", &resumable).output().unwrap();
    let message = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert_eq!(refused.status.code(), Some(2), "{message}");
    assert!(message.contains("half.safetensors"), "{message}");
}
