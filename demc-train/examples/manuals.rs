//! Writes a manual page for each command of the programs, and completions for the shells.
//!
//! ```sh
//! cargo run --release -p demc-train --example manuals -- DIR
//! ```
//!
//! DIR gets `man/man1/*.1`, `completions/bash`, `completions/zsh`, and `completions/fish`.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use clap::Command;
use clap_complete::{Shell, generate_to};

/// A shell and the name of its directory.
const SHELLS: [(Shell, &str); 3] = [
    (Shell::Bash, "bash"),
    (Shell::Zsh, "zsh"),
    (Shell::Fish, "fish"),
];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let directory: PathBuf = std::env::args_os()
        .nth(1)
        .ok_or("usage: manuals DIR")?
        .into();
    let manuals = directory.join("man/man1");
    fs::create_dir_all(&manuals)?;
    let programs = [
        demc_infer::cli::command().name("demc-infer"),
        demc_train::cli::command().name("demc-train"),
        demc_data::cli::command().name("demc-data"),
    ];
    for program in programs {
        clap_mangen::generate_to(program.clone().disable_help_subcommand(true), &manuals)?;
        complete(&program, &directory.join("completions"))?;
    }
    Ok(())
}

/// Writes the completions of a program for each shell.
fn complete(program: &Command, directory: &Path) -> io::Result<()> {
    for (shell, name) in SHELLS {
        let folder = directory.join(name);
        fs::create_dir_all(&folder)?;
        let mut program = program.clone();
        let name = program.get_name().to_owned();
        generate_to(shell, &mut program, name, folder)?;
    }
    Ok(())
}
