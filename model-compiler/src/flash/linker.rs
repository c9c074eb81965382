//! Linker script with the image's memory.

use super::{Address, elf};

pub(super) fn script(bytes: usize, name: &str, address: Address, is_linked: bool) -> String {
    // The name stands in a comment, which it must not end.
    let name = name.replace("*/", "* /");
    let (section, first, last) = (elf::SECTION, "MODEL", "ORIGIN(MODEL) + LENGTH(MODEL)");
    let content = if is_linked {
        format!(
            "/* The image is linked in: its object has the section {section}. */\n\
             SECTIONS\n{{\n  {section} ORIGIN({first}) : ALIGN(16) {{ KEEP(*({section})) }} > {first}\n}}\n"
        )
    } else {
        "/* The image is flashed beside the program. */\n".to_owned()
    };
    format!(
        "/* Memory of the model image {name:?}; to be included by memory.x, or passed to the linker by -T. */\n\
         MEMORY\n{{\n  {first} (r) : ORIGIN = {address}, LENGTH = {bytes}\n}}\n\n\
         {content}\
         PROVIDE(model_start = ORIGIN({first}));\n\
         PROVIDE(model_end = {last});\n\
         PROVIDE(model_size = LENGTH({first}));\n"
    )
}
