//! Tests the command `train`: the policy does not depend on the number of threads, the instruction
//! set, or interruptions.

use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::OnceLock;
use std::time::Duration;

use qube_hil::elementary::Level;
use rustix::process::{Pid, Signal, kill_process};

use crate::program::{qube_hil, succeeded};
use crate::shared::command_in;

fn train(directory: &Path, out: &str, more: &[&str]) -> Command {
    let mut command = command_in(directory);
    command.args(["train", "--preset", "quick", "--seed", "3", "--out", out]).args(more);
    command
}

/// The policy of an undisturbed training, which is trained once.
fn undisturbed() -> &'static [u8] {
    static POLICY: OnceLock<Vec<u8>> = OnceLock::new();
    POLICY.get_or_init(|| {
        let directory = tempfile::tempdir().unwrap();
        // A bare file name: the file goes into the working directory.
        succeeded(&train(directory.path(), "whole.safetensors", &[]).output().unwrap());
        std::fs::read(directory.path().join("whole.safetensors")).unwrap()
    })
}

#[test]
fn a_run_says_before_it_homes_that_its_policy_was_trained_on_true_states() {
    let directory = tempfile::tempdir().unwrap();
    std::fs::write(directory.path().join("quick.safetensors"), undisturbed()).unwrap();
    let run = ["run", "--policy", "quick.safetensors", "--clock", "virtual", "--out", "r"];
    let told = String::from_utf8(qube_hil(directory.path(), &run).stderr).unwrap();
    let note = "quick.safetensors was trained on true states within the box alone";
    let places = [note, "homing: "].map(|words| told.find(words));
    assert!(places[0].is_some() && places.is_sorted(), "{told}");
}

#[test]
fn the_policy_is_the_same_on_two_threads_and_with_the_instructions_of_an_older_processor() {
    let directory = tempfile::tempdir().unwrap();
    let bytes = |out: &str, more: &[&str]| {
        succeeded(&train(directory.path(), out, more).output().unwrap());
        std::fs::read(directory.path().join(out)).unwrap()
    };
    assert!(undisturbed() == bytes("threads.safetensors", &["--threads", "2"]));
    assert!(undisturbed() == bytes("avx2.safetensors", &["--instruction-set", "avx2"]));
    if !Level::Avx512.is_available() {
        println!("instruction sets are not compared: this processor has no AVX-512");
    }
}

/// Stops a training at its first checkpoint, which its last message then names. Returns whether it
/// was still running then: a computer may be so busy that this thread sees the checkpoint only
/// after the training's end.
fn stop_at_first_checkpoint(directory: &Path, resumable: &[&str; 2]) -> bool {
    let checkpoint = directory.join(resumable[1]);
    let mut training =
        train(directory, "resumed.safetensors", resumable).stderr(Stdio::piped()).spawn().unwrap();
    while !checkpoint.exists() && training.try_wait().unwrap().is_none() {
        std::thread::sleep(Duration::from_millis(2));
    }
    let _ = kill_process(Pid::from_child(&training), Signal::TERM);
    let output = training.wait_with_output().unwrap();
    let told = String::from_utf8(output.stderr).unwrap();
    let code = output.status.code();
    assert!(matches!(code, Some(0 | 143)), "{code:?}: {told}");
    let continues = format!("continues from {}", resumable[1]);
    assert_eq!(told.contains(&continues), code == Some(143), "{code:?}: {told}");
    code == Some(143)
}

#[test]
fn a_stopped_and_resumed_training_gives_the_same_policy() {
    let directory = tempfile::tempdir().unwrap();
    let checkpoint = directory.path().join("half.safetensors");
    let resumed = directory.path().join("resumed.safetensors");
    let resumable = ["--checkpoint", "half.safetensors"];

    while !stop_at_first_checkpoint(directory.path(), &resumable) {
        std::fs::remove_file(&resumed).unwrap();
    }
    assert!(checkpoint.exists() && !resumed.exists());

    succeeded(&train(directory.path(), "resumed.safetensors", &resumable).output().unwrap());
    assert!(!checkpoint.exists(), "the checkpoint of a finished training stays");
    assert!(undisturbed() == std::fs::read(&resumed).unwrap());

    std::fs::write(&checkpoint, b"nonsense").unwrap();
    let refused = train(directory.path(), "no.safetensors", &resumable).output().unwrap();
    let message = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert_eq!(refused.status.code(), Some(2), "{message}");
    assert!(message.contains("half.safetensors"), "{message}");
}

#[test]
fn a_training_that_is_stopped_names_a_checkpoint_only_if_there_is_one() {
    let directory = tempfile::tempdir().unwrap();
    let checkpoint = directory.path().join("far.safetensors");
    // The first signals may come before the program handles them.
    let stopped = [100, 400, 1600, 6400].into_iter().find_map(|milliseconds| {
        let training = command_in(directory.path())
            .args(["train", "--preset", "thesis", "--checkpoint", "far.safetensors"])
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        std::thread::sleep(Duration::from_millis(milliseconds));
        let _ = kill_process(Pid::from_child(&training), Signal::TERM);
        let output = training.wait_with_output().unwrap();
        (output.status.code() == Some(143)).then_some(output)
    });
    let told = String::from_utf8(stopped.unwrap().stderr).unwrap();
    assert_eq!(told.contains("continues from"), checkpoint.exists(), "{told}");
    assert_eq!(told.contains("nothing was written"), !checkpoint.exists(), "{told}");
}
