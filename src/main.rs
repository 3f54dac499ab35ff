//! The program `qube-hil`; the library implements its command line.

fn main() -> std::process::ExitCode {
    qube_hil::commands::main()
}
