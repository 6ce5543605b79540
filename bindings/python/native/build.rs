//! Lets `cargo build` link the module on macOS, where Python's symbols are resolved at run time.

fn main() {
    pyo3_build_config::add_extension_module_link_args();
}
