def fmu_file(equations): return {}
