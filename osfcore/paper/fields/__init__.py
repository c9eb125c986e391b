"""KiloOSF as published: tiny networks alone, trained over a teacher by distillation and fine-tuning."""
