//! The command line of qube-hil; everything it does lives in the library.

fn main() -> std::process::ExitCode {
    qube_hil::commands::main()
}
