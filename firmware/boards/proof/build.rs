//! The entry point, so that the linker keeps what it calls.

fn main() {
    println!("cargo::rustc-link-arg=-e");
    println!("cargo::rustc-link-arg=start");
}
