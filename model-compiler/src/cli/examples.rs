//! What `--help` shows at its end. A line that begins with two blanks is a command that works as it stands.

pub const ALL: &str = "Examples:
  model-compiler compile transfuser.pth --calib frames/ --target cortex-m7 -o transfuser.img
  model-compiler quantize transfuser.pth --calib inputs.safetensors --skip i16 -o transfuser.qmodel
  model-compiler compile transfuser.qmodel --ram 1536K --flash 128M -o transfuser.img
  model-compiler compile resnet20.onnx --calib images/ -o resnet20.img
  model-compiler convert transfuser.img --format hex --address 0x21000000 -o transfuser.hex
  model-compiler inspect transfuser.img
  model-compiler completions bash";

pub const QUANTIZE: &str = "Examples:
  model-compiler quantize transfuser.pth --calib frames/ -o transfuser.qmodel
  model-compiler quantize transfuser.pth --calib inputs.safetensors --skip i16 -o transfuser.qmodel
  model-compiler quantize aim.safetensors --calib frames/ --skip 0,1 --ranges minmax -o aim.qmodel";

pub const COMPILE: &str = "Examples:
  model-compiler compile transfuser.pth --calib frames/ --target cortex-m7 -o transfuser.img
  model-compiler compile resnet20.onnx --calib images/ -o resnet20.img
  model-compiler compile transfuser.qmodel --ram 1536K --flash 128M -o transfuser.img
  model-compiler compile transfuser.qmodel --region fast=64K --region main=1536K -o transfuser.img
  model-compiler compile transfuser.qmodel --target board.toml -o transfuser.img
  model-compiler compile transfuser.qmodel --target cortex-m7 --revision 2 -o transfuser.img
  model-compiler compile transfuser.qmodel --format elf --address 0x08100000 --linker model.x -o model.o";

pub const CONVERT: &str = "Examples:
  model-compiler convert transfuser.img --format hex --address 0x21000000 -o transfuser.hex
  model-compiler convert transfuser.img --format srec --address 0x21000000 --linker model.x -o transfuser.srec
  model-compiler convert transfuser.img --format elf --machine aarch64 -o model.o
  model-compiler convert transfuser.img --format rs -o src/model.rs";

pub const INSPECT: &str = "Examples:
  model-compiler inspect transfuser.img
  model-compiler inspect transfuser.qmodel
  model-compiler inspect transfuser.pth
  model-compiler inspect resnet20.onnx
  model-compiler inspect --diff before.img after.img";

pub const COMPLETIONS: &str = "In bash: `source <(model-compiler completions bash)`, now or in ~/.bashrc.

Examples:
  model-compiler completions bash
  model-compiler completions zsh";
