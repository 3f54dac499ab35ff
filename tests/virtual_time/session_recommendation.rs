//! Tests the result of a session: the policy of the recommended psi or the best candidate's,
//! whichever earned more when both were verified.

use std::path::Path;

use serde_json::Value;

use crate::program::program;

const SMALL: &str = "seed = 5\nstrategy = \"random\"\n\
    [extent]\ninitial_candidates = 3\niterations = 1\nrollouts = 1\nverification_rollouts = 2\n\
    [training]\nupdates = 2\nnum_envs = 16\nepochs = 1\n";

fn session(directory: &Path, arguments: &[&str]) -> Value {
    let mut command = program(directory);
    command.args(["session", "--clock", "virtual", "--json"]);
    let output = command.args(arguments).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

fn policy(directory: &Path, candidate: &Value) -> Vec<u8> {
    let number = candidate["candidate"].as_u64().unwrap();
    std::fs::read(directory.join(format!("s/candidates/{number:03}/policy.safetensors"))).unwrap()
}

fn mean(candidate: &Value) -> f64 {
    candidate["mean_return"].as_f64().unwrap()
}

#[test]
fn the_incumbents_policy_is_verified_beside_the_recommendation_and_the_better_is_returned() {
    let directory = tempfile::tempdir().unwrap();
    std::fs::write(directory.path().join("small.toml"), SMALL).unwrap();
    let told = session(directory.path(), &["--config", "small.toml", "--out", "s"]);
    let (searched, verified) = (&told["candidates"], &told["verified"]);
    let searched = searched.as_array().unwrap();
    let [recommended, incumbent] = verified.as_array().unwrap().as_slice() else {
        panic!("{told}")
    };
    assert_eq!(
        (&recommended["purpose"], &incumbent["purpose"]),
        (&"verification".into(), &"incumbent".into())
    );
    assert_eq!((searched.len(), incumbent["returns"].as_array().unwrap().len()), (4, 2));

    let luckiest = searched.iter().max_by(|one, other| mean(one).total_cmp(&mean(other))).unwrap();
    assert_eq!(policy(directory.path(), incumbent), policy(directory.path(), luckiest));
    assert_eq!(incumbent["psi"], luckiest["psi"]);

    let better = if mean(incumbent) > mean(recommended) { incumbent } else { recommended };
    assert_eq!(told["best"]["candidate"], better["candidate"]);
    assert!(Path::new(told["best"]["policy"].as_str().unwrap()).ends_with("policy.safetensors"));
    // A finished session is only read.
    assert_eq!(session(directory.path(), &["--resume", "s"])["best"], told["best"]);
}
