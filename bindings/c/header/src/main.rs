//! Writes `bindings/c/include/demc.h` from the sources of the C library, a section for each of them.
//!
//! ```sh
//! cargo run --manifest-path bindings/c/header/Cargo.toml              # writes the header
//! cargo run --manifest-path bindings/c/header/Cargo.toml -- --check   # compares it; exit code 1 if it differs
//! ```

use std::path::Path;
use std::process::ExitCode;
use std::{env, fs};

use cbindgen::{Builder, Config, Language, RenameRule, Style};

/// The sources in the order of the header, with the titles of their sections.
const SECTIONS: [(&str, &str); 5] = [
    ("error.rs", "Errors"),
    ("device.rs", "Device"),
    ("model.rs", "Model"),
    ("image.rs", "Images"),
    ("filter.rs", "Filter"),
];

const START: &str = include_str!("start.h");

const END: &str = "
#ifdef __cplusplus
}
#endif

#endif // DEMC_H
";

fn main() -> ExitCode {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let header = match header(&root.join("src")) {
        Ok(header) => header,
        Err(error) => {
            eprintln!("error: {error}");
            return ExitCode::FAILURE;
        }
    };
    let path = root.join("include/demc.h");
    let is_check = env::args().nth(1).as_deref() == Some("--check");
    let done = if is_check {
        fs::read_to_string(&path).map(|old| old == header)
    } else {
        fs::write(&path, &header).map(|()| true)
    };
    match done {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => {
            eprintln!("error: include/demc.h differs from the sources; run this tool");
            ExitCode::FAILURE
        }
        Err(error) => {
            eprintln!("error: {}: {error}", path.display());
            ExitCode::FAILURE
        }
    }
}

/// The text of the header.
fn header(sources: &Path) -> Result<String, cbindgen::Error> {
    let mut header = START.to_owned();
    for (file, title) in SECTIONS {
        let rule = "-".repeat(90 - title.len());
        header += &format!(
            "\n// -- {title} {rule}\n\n{}",
            section(&sources.join(file))?
        );
    }
    Ok(header + END)
}

/// The declarations of one source.
fn section(source: &Path) -> Result<String, cbindgen::Error> {
    let mut config = Config {
        language: Language::C,
        style: Style::Both,
        no_includes: true,
        documentation_style: cbindgen::DocumentationStyle::C99,
        usize_is_size_t: true,
        line_length: 100,
        ..Config::default()
    };
    config.enumeration.rename_variants = RenameRule::QualifiedScreamingSnakeCase;
    config.function.rename_args = RenameRule::CamelCase;
    config.function.prefix = Some("DEMC_API".into());
    let names = [
        ("Device", "DemcDeviceObject"),
        ("Model", "DemcModelObject"),
        ("Filter", "DemcFilterObject"),
        ("FormatCode", "DemcFormat"),
    ];
    for (rust, c) in names {
        config.export.rename.insert(rust.into(), c.into());
    }
    config.export.exclude.push("FormatCode".into());
    // No function of the same source names them.
    for name in ["DemcError", "DemcFormat"] {
        config.export.include.push(name.into());
    }
    let bindings = Builder::new()
        .with_config(config)
        .with_src(source)
        .generate()?;
    let mut text = Vec::new();
    bindings.write(&mut text);
    let text = String::from_utf8_lossy(&text).into_owned();
    // The type of the handle declares the object, too.
    let blocks: Vec<&str> = text
        .trim()
        .split("\n\n")
        .filter(|block| !block.ends_with("Object;"))
        .collect();
    // Marks of Rust's documentation.
    Ok(blocks
        .join("\n\n")
        .replace("// ```text\n", "")
        .replace("// ```\n", "")
        + "\n")
}
