//! Compares the public API of `demc-infer` with `api.txt`, which is committed.
//!
//! ```sh
//! demc-infer/api/check.sh          # prints differences; exit code 1 if there are any
//! demc-infer/api/check.sh --write  # writes api.txt
//! ```
//!
//! A difference is a change for users of the library: it belongs in the changelog.

use std::collections::BTreeSet;
use std::error::Error;
use std::process::ExitCode;

const GOLDEN: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/api.txt");

fn main() -> Result<ExitCode, Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let json = arguments
        .next()
        .ok_or("usage: demc-infer-api RUSTDOC.json [--write]")?;
    let api = public_api::Builder::from_rustdoc_json(json)
        .omit_blanket_impls(true)
        .omit_auto_trait_impls(true)
        .omit_auto_derived_impls(true)
        .build()?;
    let found: Vec<String> = api.items().map(ToString::to_string).collect();
    if arguments.next().as_deref() == Some("--write") {
        std::fs::write(GOLDEN, found.join("\n") + "\n")?;
        return Ok(ExitCode::SUCCESS);
    }
    let golden = std::fs::read_to_string(GOLDEN)?;
    let golden: BTreeSet<&str> = golden.lines().collect();
    let found: BTreeSet<&str> = found.iter().map(String::as_str).collect();
    for line in golden.difference(&found) {
        println!("- {line}");
    }
    for line in found.difference(&golden) {
        println!("+ {line}");
    }
    if golden != found {
        println!(
            "the public API differs from api.txt; `demc-infer/api/check.sh --write` accepts it"
        );
        return Ok(ExitCode::FAILURE);
    }
    println!("{} public items, as in api.txt", found.len());
    Ok(ExitCode::SUCCESS)
}
