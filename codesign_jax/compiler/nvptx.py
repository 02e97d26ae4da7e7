"""Device code of NVIDIA GPUs: from a kernel in LLVM's language to PTX, which drivers translate."""

import re

import llvmlite.binding as binding

TARGET, FEATURES = "sm_80", "+ptx78"
"""The oldest GPU and the version of PTX that the code is written for; newer ones run it too."""

_CONDITIONAL = re.compile(r"^(\s*@!?%p\d+ )bra(\s)", re.MULTILINE)


def assembly(text: str) -> str:
    """PTX of a kernel.

    Passes are few on purpose: the kernel's own text has loops and little that is computed twice,
    and passes that move loads out of loops make values live longer than there are registers.

    Args:
      text: The kernel in LLVM's language, see `thread.write`.
    """
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    target = binding.Target.from_triple("nvptx64-nvidia-cuda")
    machine = target.create_target_machine(cpu=TARGET, features=FEATURES, opt=0)
    module = binding.parse_assembly(text)
    module.data_layout = str(machine.target_data)
    module.verify()
    passes = binding.create_new_function_pass_manager()
    passes.add_new_gvn_pass()
    passes.add_aggressive_dce_pass()
    options = binding.create_pipeline_tuning_options(speed_level=1)
    builder = binding.create_pass_builder(machine, options)
    for function in module.functions:
        if not function.is_declaration:
            passes.run(function, builder)
    # Conditions are the same on all lanes, which LLVM does not know: threads need not meet again.
    return _CONDITIONAL.sub(r"\1bra.uni\2", machine.emit_assembly(module))
